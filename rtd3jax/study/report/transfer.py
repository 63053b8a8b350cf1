"""The transfer matrix: returns of trained agents under other disturbances."""

from collections.abc import Callable
from typing import Any

import numpy as np

from rtd3jax.study.report.data import summary_data
from rtd3jax.study.report.table import of_these_policies, read_table
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.statistics import summarise
from rtd3jax.study.transfer import CELL, COLUMNS, FILE


def transfer_data(
    directory: RunDirectory, policies: Callable[[], set[str]], notes: list[str]
) -> list[dict[str, Any]] | None:
    """A summary over the seeds for each agent, training and test; None without such rows.

    ``policies`` and ``notes`` are those of `of_these_policies`.

    Raises:
        UserError: when the file exists, but is not such a table.
    """
    table = read_table(directory.path / FILE, COLUMNS)
    if table is None:
        return None
    table = of_these_policies(table, policies, FILE, "transfer", notes)
    if table.empty:
        return None
    table = table.astype({"return": np.float64})
    seeds = table.groupby([*CELL, "seed"], sort=False)["return"]
    # As in `seed_means`: a lane with a NaN episode has no mean.
    means = seeds.agg(lambda episodes: episodes.mean(skipna=False)).reset_index()
    return [
        {
            **dict(zip(CELL, map(_plain, cell), strict=True)),
            **summary_data(summarise(rows["return"])),
        }
        for cell, rows in means.groupby(CELL, sort=False)
    ]


def _plain(value: object) -> Any:
    return value.item() if isinstance(value, np.generic) else value
