"""A simulator's part of an environment's state, and where it lies in states of others."""

from typing import Any

import jax
import numpy as np
from flax import struct


class SimulatorState(struct.PyTreeNode):
    """One episode, and all that replays it."""

    time: jax.Array
    """int32 []: steps taken"""
    handle: jax.Array
    """int32 []: the simulator, in the process that made it"""
    seed: jax.Array
    """uint32 []: with which the episode began"""
    digest: jax.Array
    """uint32 [2]: of all that the simulator answered in this episode, to the bit"""
    actions: jax.Array
    """float32 [T, A]: those of this episode"""
    terminated: jax.Array
    """bool []"""
    truncated: jax.Array
    """bool []: by the environment itself"""


def simulator_state(env_state: object) -> SimulatorState | None:
    """The part of an environment's state that is a simulator's; None where there is none."""
    parts = jax.tree.leaves(env_state, is_leaf=lambda part: isinstance(part, SimulatorState))
    return next((part for part in parts if isinstance(part, SimulatorState)), None)


def simulator_handles(env_state: object) -> list[int]:
    """The handles of the simulators that play one state or several; empty without simulators."""
    found = simulator_state(env_state)
    return [] if found is None else np.asarray(found.handle).reshape(-1).tolist()


def with_simulator(env_state: object, simulator: SimulatorState) -> Any:
    """An environment's state with another state of its simulator."""
    return jax.tree.map(
        lambda part: simulator if isinstance(part, SimulatorState) else part,
        env_state,
        is_leaf=lambda part: isinstance(part, SimulatorState),
    )


def without_handles(tree: object) -> Any:
    """A result with the numbers of its simulators, which every call gives anew, set to zero."""

    def plain(part: object) -> object:
        return part.replace(handle=0 * part.handle) if isinstance(part, SimulatorState) else part

    return jax.tree.map(plain, tree, is_leaf=lambda part: isinstance(part, SimulatorState))
