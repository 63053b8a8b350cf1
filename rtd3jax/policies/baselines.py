"""Policies that need no training; tables compare trained agents with them."""

import dataclasses
import math

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
    """A policy that always returns the same action [A]."""

    action: jax.Array

    def with_action_shape(self, shape: tuple[int, ...]) -> "ConstantPolicy":
        """The policy, whose action gets ``shape`` if it has as many elements."""
        if self.action.size != math.prod(shape):
            return self
        return dataclasses.replace(self, action=self.action.reshape(shape))

    def init(self, key: jax.Array | None = None) -> tuple:
        """The policy has no state."""
        return ()

    def step(self, state: tuple, observation: jax.Array) -> tuple[jax.Array, tuple]:
        """The constant action."""
        return self.action, state


@struct.dataclass
class RandomPolicy:
    """A policy with uniform random actions within the bounds."""

    bounds: Bounds
    action_shape: tuple[int, ...] = struct.field(pytree_node=False)

    def init(self, key: jax.Array | None = None) -> jax.Array:
        """The key of the random stream: ``key``, or a fixed key."""
        return jax.random.key(0) if key is None else key

    def step(self, state: jax.Array, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """A uniform random action, and the next key."""
        key, state = jax.random.split(state)
        low, high = self.bounds.low, self.bounds.high
        action = jax.random.uniform(key, low.shape, jnp.float32, low, high)
        return action.reshape(self.action_shape), state


def constant_policy(action: ArrayLike) -> ConstantPolicy:
    """The policy with the constant ``action``: a number or [A] in the environment's units.

    Raises:
        UserError: when the action is not finite.
    """
    array = jnp.atleast_1d(jnp.asarray(action, jnp.float32))
    if not bool(jnp.all(jnp.isfinite(array))):
        raise UserError(f"a constant policy needs finite actions, not {action!r}")
    return ConstantPolicy(array)


def random_policy(env: EnvironmentLike, params: object = None) -> RandomPolicy:
    """The policy with uniform random actions in ``env``, a reference of every table.

    Raises:
        UserError: for an unsuitable environment.
    """
    interface = describe(env, parameters_of(env, params))
    bounds = Bounds(jnp.asarray(interface.action_low), jnp.asarray(interface.action_high))
    return RandomPolicy(bounds, interface.action_shape)
