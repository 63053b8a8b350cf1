"""A policy whose observations and actions pass through processes."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.envs.identity import strong
from rtd3jax.envs.processes.process import Process

# Numbers folded into the keys, as in `rtd3jax.envs.disturbed`.
_OBSERVATION_STREAM, _ACTION_STREAM = 0x6F627300, 0x61637400


class ImpairedState(struct.PyTreeNode):
    """The state of one episode."""

    policy: Any
    """state of the wrapped policy"""
    key: jax.Array
    """key of the episode's random numbers"""
    time: jax.Array
    """int32 []: steps taken"""
    observation: Any
    """state of the observation's process"""
    action: Any
    """state of the action's process"""


class ImpairedPolicy(struct.PyTreeNode):
    """``policy`` behind a process of its observation and a process of its action.

    The environment does not change. So its episodes, which depend on its keys, have the same starts
    and disturbances as without the processes, and any environment can be used.
    """

    policy: Any
    observation: Process
    """process of the observation [O]"""
    action: Process
    """process of the flat action [A], in the environment's units"""
    horizon: int | jax.Array
    """time limit of an episode in steps"""
    observation_size: int = struct.field(pytree_node=False)
    action_size: int = struct.field(pytree_node=False)

    def init(self, key: jax.Array | None = None) -> ImpairedState:
        """The state before an episode; the wrapped policy gets ``key`` itself."""
        own = jax.random.key(0) if key is None else key
        observation = self.observation.init(
            jax.random.fold_in(own, _OBSERVATION_STREAM), self.horizon, self.observation_size
        )
        action = self.action.init(
            jax.random.fold_in(own, _ACTION_STREAM), self.horizon, self.action_size
        )
        inner = self.policy.init(key)
        return strong(ImpairedState(inner, own, jnp.zeros((), jnp.int32), observation, action))

    def step(self, state: ImpairedState, observation: jax.Array) -> tuple[jax.Array, ImpairedState]:
        """The action that the environment receives, for the observation that it returned."""
        key = jax.random.fold_in(state.key, state.time)
        seen, observation_state = self.observation.step(
            jax.random.fold_in(key, _OBSERVATION_STREAM), state.observation, observation
        )
        action, inner = self.policy.step(state.policy, seen)
        applied, action_state = self.action.step(
            jax.random.fold_in(key, _ACTION_STREAM), state.action, action.reshape(-1)
        )
        evolved = ImpairedState(inner, state.key, state.time + 1, observation_state, action_state)
        return applied.reshape(action.shape), strong(evolved)
