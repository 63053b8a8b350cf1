"""The transfer matrix: returns of trained agents under other disturbances."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rtd3jax.errors import UserError
from rtd3jax.study.report.data import summary_data
from rtd3jax.study.statistics import summarise

FILE = "transfer.parquet"
_CELL = ["env", "algorithm", "history_length", "trained_on", "tested_on"]
COLUMNS = (*_CELL, "seed", "episode", "return")
"""One row per lane, tested disturbance and episode."""


def transfer_data(path: Path) -> list[dict[str, Any]] | None:
    """A summary over the seeds for each agent, training and test; None without a table.

    Raises:
        UserError: when the file exists, but is not such a table.
    """
    if not path.is_file():
        return None
    try:
        table = pd.read_parquet(path)
    except (OSError, ValueError) as error:
        raise UserError(f"{path.name} cannot be read ({str(error).splitlines()[0]})") from error
    missing = [name for name in COLUMNS if name not in table.columns]
    if missing:
        raise UserError(f"{path.name} has no columns {', '.join(missing)}")
    table = table.astype({"return": np.float64})
    seeds = table.groupby([*_CELL, "seed"], sort=False)["return"]
    # As in `seed_means`: a lane with a NaN episode has no mean.
    means = seeds.agg(lambda episodes: episodes.mean(skipna=False)).reset_index()
    return [
        {
            **dict(zip(_CELL, map(_plain, cell), strict=True)),
            **summary_data(summarise(rows["return"])),
        }
        for cell, rows in means.groupby(_CELL, sort=False)
    ]


def _plain(value: object) -> Any:
    return value.item() if isinstance(value, np.generic) else value
