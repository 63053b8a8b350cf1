"""What is written when training has ended: ceilings, tables, pictures and the page."""

from collections.abc import Sequence

from rtd3jax.study.ceilings import compute_ceilings
from rtd3jax.study.derive import Reference, derive
from rtd3jax.study.report.page import refresh_page
from rtd3jax.study.rundir import RunDirectory


def finish(
    directory: RunDirectory,
    references: Sequence[Reference],
    *,
    page: bool,
    interrupted: bool = False,
) -> None:
    """Write what is made from the lanes there are.

    Args:
        directory: the run.
        references: policies that need no training.
        page: whether to write the page, and the ceilings that it shows.
        interrupted: whether training was ended before its time.
    """
    # Of several processes the last to end has the rest to do.
    complete = page and directory.has_ended() and not interrupted
    if complete:
        compute_ceilings(directory.path, directory.cells)
    derive(directory, references)
    if page:
        refresh_page(directory, complete=complete)
