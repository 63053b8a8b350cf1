"""Trains and tests the lanes that a table of an experiment does not have yet.

The table of an experiment is the record of what is done: if a command is repeated, also on another
machine, only what is missing is trained and tested.
"""

import pathlib
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

import rtd3jax as rtd

FINAL_EPISODES = 20
"""Episodes of the last test in a study, as in the paper."""

Has = Callable[[pd.DataFrame, rtd.Cell, int], bool]
"""Whether a table has the tests of a cell's seed."""


def train(cells: list[rtd.Cell], seeds: Sequence[int], run: pathlib.Path, quick: bool) -> list[str]:
    """Train cells as a study in ``run``; return a line for each lane that was lost."""
    study = rtd.Study(cells, seeds=seeds, out=run, final_episodes=1 if quick else FINAL_EPISODES)
    return study.run(quiet=quick, page=not quick)


def train_missing(
    table: object,
    cells: list[rtd.Cell],
    missing: list[rtd.Cell],
    seeds: Sequence[int],
    run: pathlib.Path,
    quick: bool,
) -> list[str]:
    """`train` the ``missing`` cells, and print how many of ``cells`` the ``table`` has already."""
    print(f"{table} has {len(cells) - len(missing)} of {len(cells)} cells", flush=True)
    return train(missing, seeds, run, quick) if missing else []


def not_in(
    rows: pd.DataFrame, cells: list[rtd.Cell], seeds: Sequence[int], has: Has
) -> list[rtd.Cell]:
    """The cells of which ``rows`` does not have all seeds."""
    return [cell for cell in cells if not all(has(rows, cell, seed) for seed in seeds)]


def untested_policies(
    run: pathlib.Path, cells: list[rtd.Cell], rows: pd.DataFrame, seeds: Sequence[int], has: Has
) -> tuple[list[tuple[rtd.Cell, int, rtd.Policy]], list[str]]:
    """The trained policies in ``run`` that ``rows`` does not have, and a line for each missing one.

    A policy comes with its cell and seed.
    """
    found, missing = [], set()
    for cell in cells:
        for seed in (seed for seed in seeds if not has(rows, cell, seed)):
            try:
                found.append((cell, seed, rtd.load_policy(run, **cell.key, seed=seed)))
            except rtd.UserError as error:
                missing.add(str(error))
    return found, sorted(missing)


def mean_and_error(returns: np.ndarray) -> dict[str, float]:
    """The mean of returns, and its standard error, as columns of a table."""
    error = returns.std(ddof=1) / np.sqrt(len(returns))
    return {"mean": float(returns.mean()), "standard_error": float(error)}


def kept(path: pathlib.Path, columns: list[str]) -> pd.DataFrame:
    """The rows of an existing table; otherwise no rows, with these columns."""
    return pd.read_parquet(path) if path.exists() else pd.DataFrame(columns=columns)


def joined(rows: pd.DataFrame, new: list[dict], key: list[str]) -> pd.DataFrame:
    """``rows`` and ``new``, which replace rows with the same values in the columns ``key``."""
    if not new:
        return rows
    both = pd.DataFrame(new) if rows.empty else pd.concat([rows, pd.DataFrame(new)])
    return both.drop_duplicates(key, keep="last").reset_index(drop=True)
