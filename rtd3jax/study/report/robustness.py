"""The test of robustness of a study, as data of its page."""

from collections.abc import Callable
from typing import Any

from rtd3jax.study.report.data import MEASURES, curve_data, rows_of
from rtd3jax.study.report.table import of_these_policies, read_table
from rtd3jax.study.robustness import COLUMNS, FILE
from rtd3jax.study.rundir import RunDirectory


def robustness_data(
    directory: RunDirectory, policies: Callable[[], set[str]], notes: list[str]
) -> list[dict[str, Any]] | None:
    """Each stress of each cell, with a curve over its values; None without rows of these policies.

    ``cell`` is an index of the study's cells. A curve is the interquartile mean over the seeds,
    with the bounds of its interval, as for learning curves. ``policies`` and ``notes`` are those of
    `of_these_policies`.

    Raises:
        UserError: when the file exists, but is not such a table.
    """
    table = read_table(directory.path / FILE, COLUMNS)
    if table is None:
        return None
    table = of_these_policies(table, policies, FILE, "stress", notes)
    if table.empty:
        return None
    return [
        {
            "cell": index,
            "stress": stress,
            "quantity": str(rows["quantity"].iloc[0]),
            "curves": {measure: curve_data(rows, measure, "value") for measure in MEASURES},
        }
        for index, cell in enumerate(directory.cells)
        for stress, rows in rows_of(table, cell).groupby("stress", sort=False)
    ]
