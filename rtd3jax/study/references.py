"""Policies that need no training, evaluated for comparison."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rtd3jax.evaluation.rollout import both_returns
from rtd3jax.policies.baselines import constant_policy, random_policy
from rtd3jax.study.plan import Cell
from rtd3jax.study.rundir import Reference

EPISODES = 1_000


def references_of(cells: Sequence[Cell]) -> list[Reference]:
    """Uniform random, and the rover's constant command, on each world of a study."""
    worlds = {(cell.env, cell.disturbance): cell for cell in cells}
    return [reference for cell in worlds.values() for reference in references_on(cell)]


def references_on(cell: Cell) -> list[Reference]:
    """Those of one cell's world."""
    env = cell.make_env()
    policies: dict[str, Any] = {"random": random_policy(env)}
    if cell.env == "rover":
        params = env.default_params
        params = getattr(params, "env", params)  # of a rover with faults
        policies["constant"] = constant_policy([params.target_speed, params.target_yaw_rate])
    return [
        Reference(
            cell.env,
            cell.disturbance,
            name,
            *map(np.asarray, both_returns(policy, env, EPISODES, 0)),
        )
        for name, policy in policies.items()
    ]
