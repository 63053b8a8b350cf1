"""Tables, pictures and the page of a run that is still under way."""

import time
from collections.abc import Sequence

from rtd3jax.study.derive import Reference, derive
from rtd3jax.study.report.page import refresh_page
from rtd3jax.study.rundir import RunDirectory

SECONDS = 60.0
"""Between two writings of the tables and the page, at least."""


class InterimResults:
    """Writes tables, pictures and page again while lanes are still trained."""

    def __init__(self, directory: RunDirectory, references: Sequence[Reference], *, page: bool):
        self._directory = directory
        self._references = references
        self._page = page
        self._made = time.perf_counter()

    def refresh(self) -> None:
        """Write them, unless they were written less than `SECONDS` ago."""
        if time.perf_counter() - self._made > SECONDS:
            derive(self._directory, self._references)
            if self._page:
                refresh_page(self._directory, complete=False)
            self._made = time.perf_counter()
