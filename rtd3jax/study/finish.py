"""Writes the results when training has ended: ceilings, tables, figures and the page."""

from collections.abc import Sequence

from rtd3jax.study.ceilings import compute_ceilings
from rtd3jax.study.derive import Reference, derive
from rtd3jax.study.lock import deriver
from rtd3jax.study.report.page import refresh_page
from rtd3jax.study.rundir import RunDirectory


def finish(
    directory: RunDirectory,
    references: Sequence[Reference],
    *,
    page: bool,
    interrupted: bool = False,
) -> None:
    """Write the results of the lanes that have ended.

    Args:
        directory: the run directory.
        references: policies that need no training.
        page: whether to write the page.
        interrupted: whether the training was interrupted.
    """
    # Of shards that end together, the last one that holds the lock finds that every lane has ended.
    # It also writes the page last, so that no page without the lanes of others replaces its page.
    with deriver(directory.path):
        complete = directory.has_ended() and not interrupted
        if complete:
            compute_ceilings(directory.path, directory.cells)
        derive(directory, references, locked=True)
        if page:
            refresh_page(directory, complete=complete)
