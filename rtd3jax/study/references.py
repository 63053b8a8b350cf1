"""Evaluates policies that need no training, for comparison."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rtd3jax.envs.compat.simulated import is_simulated
from rtd3jax.envs.registry import description_of
from rtd3jax.errors import UserError, short_reason
from rtd3jax.evaluation.returns import both_returns
from rtd3jax.policies.baselines import constant_policy, random_policy
from rtd3jax.registries import AGENTS
from rtd3jax.study.cells import Cell
from rtd3jax.study.derive import Reference

EPISODES = 1_000
SIMULATED_EPISODES = 100
"""Episodes in a simulator on the host, which is slower."""


def references_of(cells: Sequence[Cell]) -> list[Reference]:
    """The random policy and the baselines, evaluated in each environment of a study."""
    distinct = {(cell.env, cell.disturbance): cell for cell in cells}
    return [reference for cell in distinct.values() for reference in references_on(cell)]


def references_on(cell: Cell) -> list[Reference]:
    """The random policy and the baselines, evaluated in the environment of a cell.

    Raises:
        UserError: when a baseline fails, or does not fit the environment.
    """
    env = cell.make_env()
    policies: dict[str, Any] = {"random": random_policy(env)}
    for name, make_policy in description_of(env, cell.env).baselines.items():
        if name in AGENTS:
            raise UserError(f"the baseline {name!r} of {cell.env} has the name of an agent")
        try:
            made = make_policy(env)
            if made is not None:
                policies[name] = made if hasattr(made, "step") else constant_policy(made)
        except UserError:
            raise
        except Exception as error:  # a user's function may raise any error
            reason = short_reason(error)
            raise UserError(f"the baseline {name!r} of {cell.env} failed: {reason}") from error
    episodes = SIMULATED_EPISODES if is_simulated(env) else EPISODES
    return [
        Reference(
            cell.env,
            cell.disturbance,
            name,
            *map(np.asarray, both_returns(policy, env, episodes, 0)),
        )
        for name, policy in policies.items()
    ]
