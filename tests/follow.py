"""A plant whose task is the same in all units of its actions and its sensors."""

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces


class Params(struct.PyTreeNode):
    """Ranges and units are parameters, so that one program serves them all."""

    max_steps_in_episode: int = 20
    centre: jax.Array | tuple = (0.0, 0.0)
    half_range: jax.Array | tuple = (1.0, 1.0)
    unit: jax.Array | tuple = (1.0, 1.0, 1.0)


class State(struct.PyTreeNode):
    time: jax.Array
    x: jax.Array


class Follow(environment.Environment):
    """Reward: minus the squared distance of each action, in half ranges, from what is there."""

    @property
    def default_params(self):
        return Params()

    def reset_env(self, key, params):
        x = jax.random.uniform(key, (3,), jnp.float32, -1, 1)
        return x * jnp.asarray(params.unit), State(jnp.int32(0), x)

    def step_env(self, key, state, action, params):
        action = (action - jnp.asarray(params.centre)) / jnp.asarray(params.half_range)
        reward = -jnp.sum(jnp.square(action - state.x[:2]))
        new = State(state.time + 1, 0.9 * state.x)
        return new.x * jnp.asarray(params.unit), new, reward, jnp.asarray(False), {}

    def action_space(self, params=None):
        centre, half_range = jnp.asarray(params.centre), jnp.asarray(params.half_range)
        return spaces.Box(centre - half_range, centre + half_range, (2,))
