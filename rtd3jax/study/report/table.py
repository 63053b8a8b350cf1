"""Reads the tables that some commands add to a run, for the page."""

import contextlib
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd

from rtd3jax.errors import UserError
from rtd3jax.study.results import LANE
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.parquet import read_parquet


def policies_of(directory: RunDirectory) -> set[str]:
    """The digests of the files of the lanes whose policies can be tested."""
    lanes, found = directory.lanes, set()
    for cell, seed in itertools.product(directory.cells, directory.seeds):
        with contextlib.suppress(UserError):  # a damaged file, of which the page has a note
            if lanes.is_done(cell, seed) and not lanes.is_lost(cell, seed):
                found.add(lanes.digest(cell, seed))
    return found


def of_these_policies(
    table: pd.DataFrame,
    policies: Callable[[], set[str]],
    file: str,
    command: str,
    notes: list[str],
) -> pd.DataFrame:
    """The rows of the policies that a study has now.

    Args:
        table: the table of a command that tests policies. An earlier version wrote no column
            `LANE`; all of its rows are kept.
        policies: returns `policies_of` the study; called only if the table has the column `LANE`.
        file: the name of the table's file.
        command: the command that writes the table.
        notes: receives a line about rows of other policies, and one about policies without rows.
    """
    if LANE not in table:
        return table
    now, tested = policies(), set(table[LANE])
    if others := len(tested - now):
        notes.append(
            f"{file} has returns of {others} policies that the study has no longer, which are left "
            f"out: repeat python -m rtd3jax.{command}"
        )
    if lacking := len(now - tested):
        notes.append(f"{file} lacks {lacking} of the study's {len(now)} policies")
    return table[table[LANE].isin(now)]


def read_table(path: Path, columns: Sequence[str]) -> pd.DataFrame | None:
    """The table in ``path``, which has at least ``columns``; None if there is no file.

    Raises:
        UserError: when the file exists, but is not such a table.
    """
    if not path.is_file():
        return None
    table = read_parquet(path).to_pandas()
    missing = [name for name in columns if name not in table.columns]
    if missing:
        raise UserError(f"{path.name} has no columns {', '.join(missing)}")
    return table
