"""The state of a simulator within an environment's state, and functions that find it there."""

from typing import Any

import jax
import numpy as np
from flax import struct


class SimulatorState(struct.PyTreeNode):
    """The state of one episode, from which the episode can be replayed."""

    time: jax.Array
    """int32 []: steps taken"""
    handle: jax.Array
    """int32 []: handle of the simulator, valid in the process that made it"""
    seed: jax.Array
    """uint32 []: seed of the episode's reset"""
    digest: jax.Array
    """uint32 [2]: hash of all observations and rewards of the episode"""
    actions: jax.Array
    """float32 [T, A]: actions of the episode; T is the largest number of steps"""
    terminated: jax.Array
    """bool []"""
    truncated: jax.Array
    """bool []: whether the simulator itself reported a truncation"""


def simulator_state(env_state: object) -> SimulatorState | None:
    """The simulator's state within an environment's state; None without a simulator."""
    parts = jax.tree.leaves(env_state, is_leaf=lambda part: isinstance(part, SimulatorState))
    return next((part for part in parts if isinstance(part, SimulatorState)), None)


def simulator_handles(env_state: object) -> list[int]:
    """The handles of the simulators that play one state or several; empty without simulators."""
    found = simulator_state(env_state)
    return [] if found is None else np.asarray(found.handle).reshape(-1).tolist()


def with_simulator(env_state: object, simulator: SimulatorState) -> Any:
    """An environment's state, in which ``simulator`` replaces the simulator's state."""
    return jax.tree.map(
        lambda part: simulator if isinstance(part, SimulatorState) else part,
        env_state,
        is_leaf=lambda part: isinstance(part, SimulatorState),
    )


def without_handles(tree: object) -> Any:
    """``tree`` with all simulators' handles set to zero, because every call returns new handles."""

    def plain(part: object) -> object:
        return part.replace(handle=0 * part.handle) if isinstance(part, SimulatorState) else part

    return jax.tree.map(plain, tree, is_leaf=lambda part: isinstance(part, SimulatorState))
