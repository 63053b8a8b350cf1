"""Reads the tables that some commands add to a run, for the page."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from rtd3jax.errors import UserError
from rtd3jax.study.rundir import RunDirectory

NAMES = {"robustness": "stress"}
"""Names of commands that differ from those of their tables."""


LANE = "lane"
"""The column with the digest of the lane's file, whose policy was tested."""


def of_these_policies(
    table: pd.DataFrame, directory: RunDirectory, name: str, notes: list[str]
) -> pd.DataFrame:
    """The rows of the policies that the study has now; a note tells of others, and of policies
    without rows.

    Args:
        table: the table of a command that tests policies. An earlier version wrote no column
            `LANE`; all of its rows are kept.
        directory: the study.
        name: the command's name, and that of the table.
        notes: receives the note.
    """
    if LANE not in table:
        return table
    lanes = directory.lanes
    now = {
        lanes.digest(cell, seed)
        for cell in directory.cells
        for seed in directory.seeds
        if lanes.is_done(cell, seed) and not lanes.is_lost(cell, seed)
    }
    tested = set(table[LANE])
    if others := len(tested - now):
        notes.append(
            f"{name}.parquet has returns of {others} policies that the study has no longer, which "
            f"are left out: repeat python -m rtd3jax.{NAMES.get(name, name)}"
        )
    if lacking := len(now - tested):
        notes.append(f"{name}.parquet lacks {lacking} of the study's {len(now)} policies")
    return table[table[LANE].isin(now)]


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
