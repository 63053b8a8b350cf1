"""Policies that need no training: the references of every table."""

import jax
import jax.numpy as jnp
from flax import struct
from jax.typing import ArrayLike

from rtd3jax.agents.bounds import Bounds
from rtd3jax.envs.entry import parameters_of
from rtd3jax.envs.interface import describe
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike


@struct.dataclass
class ConstantPolicy:
    """Always the same action [A]."""

    action: jax.Array

    def init(self, key: jax.Array | None = None) -> tuple:
        """No state."""
        return ()

    def step(self, state: tuple, observation: jax.Array) -> tuple[jax.Array, tuple]:
        """The constant action."""
        return self.action, state


@struct.dataclass
class RandomPolicy:
    """Uniform within the action's bounds."""

    bounds: Bounds
    action_shape: tuple[int, ...] = struct.field(pytree_node=False)

    def init(self, key: jax.Array | None = None) -> jax.Array:
        """The stream of random numbers; ``key`` starts it (default: a fixed one)."""
        return jax.random.key(0) if key is None else key

    def step(self, state: jax.Array, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """A uniform action, and the next state of the stream."""
        key, state = jax.random.split(state)
        low, high = self.bounds.low, self.bounds.high
        action = jax.random.uniform(key, low.shape, jnp.float32, low, high)
        return action.reshape(self.action_shape), state


def constant_policy(action: ArrayLike) -> ConstantPolicy:
    """The policy that always does ``action``: a number or [A] in the environment's units."""
    array = jnp.atleast_1d(jnp.asarray(action, jnp.float32))
    if not bool(jnp.all(jnp.isfinite(array))):
        raise UserError(f"a constant policy needs finite actions, not {action!r}")
    return ConstantPolicy(array)


def random_policy(env: EnvironmentLike, params: object = None) -> RandomPolicy:
    """The uniform-random policy of ``env``: the floor of every table."""
    interface = describe(env, parameters_of(env, params))
    bounds = Bounds(jnp.asarray(interface.action_low), jnp.asarray(interface.action_high))
    return RandomPolicy(bounds, interface.action_shape)
