"""Reads the tables that some commands add to a run, for the page."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from rtd3jax.errors import UserError


def read_table(path: Path, columns: Sequence[str]) -> pd.DataFrame | None:
    """The table, which has at least ``columns``; None if there is none.

    Raises:
        UserError: when the file exists, but is not such a table.
    """
    if not path.is_file():
        return None
    try:
        table = pd.read_parquet(path)
    except (OSError, ValueError) as error:
        raise UserError(f"{path.name} cannot be read ({str(error).splitlines()[0]})") from error
    missing = [name for name in columns if name not in table.columns]
    if missing:
        raise UserError(f"{path.name} has no columns {', '.join(missing)}")
    return table
