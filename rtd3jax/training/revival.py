"""The revival of a lane's simulators on the host when it continues from a checkpoint."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from rtd3jax.envs.compat.simulated import innermost
from rtd3jax.envs.compat.simulator_state import simulator_state, with_simulator
from rtd3jax.system.jax_settings import random_key
from rtd3jax.training.lane import HEALTHY, Lane, LaneState
from rtd3jax.training.loop import REVIVED, Program


def revived(program: Program, lane: Lane, state: LaneState, step: int) -> LaneState:
    """Restore the simulators of a lane from a checkpoint; if impossible, begin new episodes."""
    env: Any = innermost(program.env)
    simulator = simulator_state(state.env_state)
    if simulator is None:
        return state
    if int(state.failure) != HEALTHY:
        # Its handles were those of another process, and may be those of other lanes here.
        none = dataclasses.replace(simulator, handle=jnp.full_like(simulator.handle, -1))
        return dataclasses.replace(state, env_state=with_simulator(state.env_state, none))
    found = env.restored(simulator)
    if found is not None:
        there = with_simulator(state.env_state, found)
        return dataclasses.replace(state, env_state=there)
    root = random_key(lane.seed)
    key = jax.random.fold_in(jax.random.fold_in(root, REVIVED), step)
    observation, env_state = program.reset(key, lane)
    state = jax.jit(program.cut)(lane, state, jnp.int32(step // program.config.environments))
    return dataclasses.replace(
        state,
        env_state=env_state,
        observation=observation.astype(jnp.float32).reshape(state.observation.shape),
        previous_action=jnp.zeros_like(state.previous_action),
        episode_step=jnp.zeros_like(state.episode_step),
        carry=jax.tree.map(jnp.zeros_like, state.carry),
        metrics=dataclasses.replace(
            state.metrics, episode_return=jnp.zeros_like(state.metrics.episode_return)
        ),
    )
