"""Tests the robustness of the trained agents of a run."""

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rtd3jax.errors import UserError
from rtd3jax.evaluation.robustness import MEASURED, Case, check_policy, make_cases, rows_of
from rtd3jax.evaluation.robustness_plot import plot_robustness
from rtd3jax.study.cells import Cell
from rtd3jax.study.colours import ordered
from rtd3jax.study.lane_files import file_name
from rtd3jax.study.plants import CheckedEnvironments
from rtd3jax.study.results import CELL, LANE
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import check_writable, write_bytes_atomically
from rtd3jax.system.numbers import check_counts

FILE = "robustness.parquet"
COLUMNS = (*CELL, "seed", *MEASURED)
"""One row per lane, stress and value: means over the episodes of a lane."""


def run_robustness(
    directory: RunDirectory,
    stresses: Sequence[str] | None,
    episodes: int,
    say: Callable[[str], None] = print,
) -> pd.DataFrame:
    """Test every trained policy of ``directory``, and write ``robustness.parquet``.

    Args:
        directory: the run directory.
        stresses: stresses, as `rtd3jax.robustness` takes them; all stresses of each environment by
            default. In a run of several environments, a stress may be unknown to some of them.
        episodes: number of episodes for each policy and value. The seed of a lane is also the seed
            of its episodes, so agents with the same seed meet the same episodes.
        say: receives a line if a stress does not fit an environment, a lane has no policy, or the
            code of a plant has changed since the study began.

    Returns:
        The table, with the columns `COLUMNS` and `LANE`.

    Raises:
        UserError: for an unknown stress or an impossible value, when nothing is trained yet, when
            no plant is the one of the study, or when the table could not be written.
    """
    check_counts(episodes, 0)
    check_writable(directory.path)
    lanes = [
        (cell, seed)
        for cell in directory.cells
        for seed in directory.seeds
        if directory.lanes.is_done(cell, seed)
    ]
    if not lanes:
        raise UserError(
            f"{directory.path} has no finished lane that could be tested: --status prints the lanes"
        )
    cases = _all_cases(directory, [cell for cell, _ in lanes], stresses, say)
    rows: list[dict[str, Any]] = []
    for cell, seed in lanes:
        own = cases.get((cell.env, cell.disturbance))
        if own is None:
            continue
        try:
            policy = directory.lanes.policy(cell, seed)
        except UserError as error:  # lost in training, or its file is damaged
            say(f"not tested: {error}")
            continue
        check_policy(policy, own)
        identity = {**cell.key, "seed": seed, LANE: directory.lanes.digest(cell, seed)}
        rows += [{**identity, **row} for row in rows_of(policy, own, episodes, seed)]
    if not rows:
        raise UserError(f"no policy in {directory.path} could be tested: --status prints the lanes")
    table = pd.DataFrame(rows, columns=[*COLUMNS, LANE])
    write_bytes_atomically(directory.path / FILE, table.to_parquet(index=False))
    return table


def draw_robustness(table: pd.DataFrame, directory: Path) -> list[Path]:
    """Draw a picture for each environment and disturbance; return the paths.

    A line is the mean over the seeds, with a band of two standard errors of this mean.
    """
    paths = []
    for (env, disturbance), rows in table.groupby(["env", "disturbance"], sort=False):
        buffer = io.BytesIO()
        title = f"{env}, trained under {disturbance}"
        plot_robustness(over_seeds(rows), title=title).savefig(buffer, format="png")
        paths.append(directory / f"robustness_{file_name(str(env), str(disturbance))}.png")
        write_bytes_atomically(paths[-1], buffer.getvalue())
    return paths


def over_seeds(rows: pd.DataFrame) -> pd.DataFrame:
    """Means over the seeds, with their standard errors, as a table for `plot_robustness`."""
    agents = rows[["algorithm", "history_length"]].drop_duplicates()
    several = len(set(agents["history_length"]) - {0}) > 1
    found = []
    for algorithm in ordered(agents["algorithm"]):
        for length in agents.loc[agents["algorithm"] == algorithm, "history_length"]:
            own = rows[(rows["algorithm"] == algorithm) & (rows["history_length"] == length)]
            returns = own.groupby(["stress", "quantity", "value"], sort=False)["return"]
            mean = returns.agg(lambda seeds: seeds.mean(skipna=False))
            error = returns.std(ddof=1) / np.sqrt(returns.count())
            means = pd.DataFrame({"return": mean, "standard_error": error}).reset_index()
            name = f"{algorithm}, history {length}" if several and length else algorithm
            found.append(means.assign(policy=name))
    return pd.concat(found, ignore_index=True)


def _all_cases(
    directory: RunDirectory,
    cells: Sequence[Cell],
    stresses: Sequence[str] | None,
    say: Callable[[str], None],
) -> dict[tuple[str, str], list[Case]]:
    """The cases of each environment and disturbance.

    If one of the stresses does not fit an environment, this environment has no cases, and ``say``
    receives a line. UserError if no environment has cases.
    """
    environments = CheckedEnvironments(directory.check_plants, say)
    cases: dict[tuple[str, str], list[Case]] = {}
    problems: list[UserError] = []
    for key, cell in {(cell.env, cell.disturbance): cell for cell in cells}.items():
        try:
            cases[key] = make_cases(environments.of(cell), stresses, env_id=cell.env)
        except UserError as error:
            problems.append(error)
            say(f"not tested on {cell.env} with {cell.disturbance}: {error}")
    if not cases:
        raise problems[0]
    return cases
