"""Interim results: tables, figures and the page of a run during training."""

import time
from collections.abc import Sequence

from rtd3jax.study.derive import Reference, derive
from rtd3jax.study.report.page import refresh_page
from rtd3jax.study.rundir import RunDirectory

SECONDS = 60.0
"""Minimum time in seconds between two updates of the tables and the page."""


class InterimResults:
    """Updates tables, figures and the page during training."""

    def __init__(self, directory: RunDirectory, references: Sequence[Reference], *, page: bool):
        self._directory = directory
        self._references = references
        self._page = page
        self._made = time.perf_counter()

    def refresh(self) -> None:
        """Update the results, unless this was done less than `SECONDS` ago."""
        if time.perf_counter() - self._made > SECONDS:
            derive(self._directory, self._references)
            if self._page:
                refresh_page(self._directory, complete=False)
            self._made = time.perf_counter()
