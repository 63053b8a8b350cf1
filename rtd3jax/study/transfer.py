"""Tests the trained agents of a run under other disturbances."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from rtd3jax.errors import UserError
from rtd3jax.evaluation.returns import both_returns
from rtd3jax.study.cells import Cell
from rtd3jax.study.plants import CheckedEnvironments
from rtd3jax.study.results import LANE
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import check_writable, write_bytes_atomically
from rtd3jax.system.numbers import check_counts

FILE = "transfer.parquet"
CELL = ["env", "algorithm", "history_length", "trained_on", "tested_on"]
COLUMNS = (*CELL, "seed", "episode", "return")
"""Columns of the table besides ``true_return`` and `LANE`.

There is one row per lane, tested disturbance and episode."""


def transfer(
    directory: RunDirectory,
    tested_on: Sequence[str] | None,
    episodes: int,
    say: Callable[[str], None] = print,
    *,
    cells: Sequence[Cell] | None = None,
    write: bool = True,
) -> pd.DataFrame:
    """Test every trained policy of ``directory``, and write the returns to ``transfer.parquet``.

    Args:
        directory: the run directory.
        tested_on: disturbances; by default those that the run has for the same environment.
        episodes: number of episodes for each policy and disturbance. The seed of a lane is also the
            seed of its episodes, so agents with the same seed meet the same episodes.
        cells: cells whose policies are tested; all cells by default.
        write: whether to write the table to the run directory.
        say: receives a line if a disturbance does not fit some policies, or the code of a plant has
            changed since the study began.

    Returns:
        The table, with the columns `COLUMNS`, ``true_return`` and `LANE`.

    Raises:
        UserError: when no plant could be made with any of the disturbances, or each has changed
            since the study began; when nothing is trained yet; when the table could not be written.
    """
    check_counts(episodes, 0)
    if write:
        check_writable(directory.path)
    rows: list[dict[str, Any]] = []
    environments, any_made = CheckedEnvironments(directory.check_plants, say), False
    problems: dict[tuple[str, str, str], int] = {}
    # The file of a policy is read once for all disturbances.
    policy_of = functools.lru_cache(maxsize=len(directory.seeds))(directory.lanes.policy)
    digest_of = functools.lru_cache(maxsize=len(directory.seeds))(directory.lanes.digest)
    for cell in directory.cells if cells is None else cells:
        own = list(dict.fromkeys(c.disturbance for c in directory.cells if c.env == cell.env))
        for disturbance in own if tested_on is None else dict.fromkeys(tested_on):
            for seed in directory.seeds:
                try:
                    environments.of(cell)  # the agents must have been trained on this plant
                    env = environments.of(Cell(cell.env, disturbance, cell.config))
                    any_made = True
                    if not directory.lanes.is_done(cell, seed):
                        continue
                    both = both_returns(policy_of(cell, seed), env, episodes, seed)
                except UserError as error:
                    problem = cell.disturbance, disturbance, str(error)
                    problems[problem] = problems.get(problem, 0) + 1
                    continue
                rows += [
                    {
                        "env": cell.env,
                        "algorithm": cell.config.algorithm,
                        "history_length": cell.config.window_tokens,
                        "trained_on": cell.disturbance,
                        "tested_on": disturbance,
                        "seed": seed,
                        "episode": episode,
                        "return": float(value),
                        "true_return": float(true),
                        LANE: digest_of(cell, seed),
                    }
                    for episode, (value, true) in enumerate(
                        zip(*map(np.asarray, both), strict=True)
                    )
                ]
    for (trained_on, tested, reason), agents in problems.items():
        say(f"not tested on {tested}: {agents} agents trained on {trained_on}: {reason}")
    if problems and not any_made:  # no environment has such a disturbance
        raise UserError(next(iter(problems))[2])
    if not rows:
        raise UserError(f"no policy in {directory.path} could be tested: --status prints the lanes")
    table = pd.DataFrame(rows, columns=[*COLUMNS, "true_return", LANE])
    if write:
        write_bytes_atomically(directory.path / FILE, table.to_parquet(index=False))
    return table
