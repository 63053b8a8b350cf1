"""The test of robustness of a study, as data of its page."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from rtd3jax.evaluation.robustness import MEASURED
from rtd3jax.study.report.data import MEASURES, rows_of
from rtd3jax.study.report.table import of_these_policies, read_table
from rtd3jax.study.results import CELL, rounded_number
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.statistics import iqm_bands

FILE = "robustness.parquet"
COLUMNS = (*CELL, "seed", *MEASURED)
"""One row per lane, stress and value: means over the episodes of a lane."""


def robustness_data(
    directory: RunDirectory, policies: Callable[[], set[str]], notes: list[str]
) -> list[dict[str, Any]] | None:
    """Each stress of each cell, with a curve over its values; None without a table.

    ``cell`` is an index of the study's cells. A curve is the interquartile mean over the seeds,
    with the bounds of its interval, as of learning curves. ``policies`` and ``notes`` are those of
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
            "curves": {measure: _curve(rows, measure) for measure in MEASURES},
        }
        for index, cell in enumerate(directory.cells)
        for stress, rows in rows_of(table, cell).groupby("stress", sort=False)
    ]


def _curve(rows: pd.DataFrame, measure: str) -> dict[str, Any] | None:
    """IQM over the seeds with the bounds of its interval, at each value of a stress."""
    rows = rows[np.isfinite(rows[measure].astype(np.float64))]
    if rows.empty:
        return None
    table = rows.pivot(index="seed", columns="value", values=measure)
    count, iqm, low, high = iqm_bands(table.to_numpy(np.float64))
    return {
        # The page's curves have their points at "steps".
        "steps": [rounded_number(value) for value in table.columns],
        "seeds": [int(seeds) for seeds in count],
        "iqm": [rounded_number(value) for value in iqm],
        "low": [rounded_number(value) for value in low],
        "high": [rounded_number(value) for value in high],
    }
