"""Interim results: tables, figures and the page of a run during training."""

import sys
import time
from collections.abc import Sequence

from rtd3jax.errors import short_reason
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
        self._said: set[str] = set()

    def refresh(self) -> None:
        """Update the results, unless this was done less than `SECONDS` ago.

        Nothing is done while another shard updates them, because the training would wait for it. An
        error, such as a damaged file of another lane, is printed once, and the training goes on.
        """
        if time.perf_counter() - self._made <= SECONDS:
            return
        try:
            derive(self._directory, self._references, wait=False)
            if self._page:
                refresh_page(self._directory, complete=False)
        except BlockingIOError:
            pass  # another shard writes them now
        except Exception as error:
            if (reason := short_reason(error)) not in self._said:
                print(f"no tables during the training: {reason}", file=sys.stderr)
                self._said.add(reason)
        self._made = time.perf_counter()
