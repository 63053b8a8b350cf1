"""A step with an automatic reset that is computed only at the end of an episode."""

from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike


class ResettableWhere(Protocol):
    """The methods of an environment that `step_with_reset` calls."""

    step_env: Callable[..., tuple]
    is_truncated: Callable[..., jax.Array]
    reset_where: Callable[..., tuple]


def step_with_reset(
    env: ResettableWhere, key: jax.Array, state: object, action: ArrayLike, params: object
) -> tuple:
    """As gymnax's ``step``, but ``env.reset_where`` resets only at the end of an episode."""
    key_step, key_reset = jax.random.split(key)
    final, evolved, reward, terminated, info = env.step_env(key_step, state, action, params)
    truncated = env.is_truncated(evolved, params)
    done = terminated | truncated
    first, fresh = env.reset_where(done, key_reset, evolved, params)

    def either(new: jax.Array, old: jax.Array) -> jax.Array:
        return new if new is old else jnp.where(done, new, old)

    seen, following = either(first, final), jax.tree.map(either, fresh, evolved)
    info = {**info, "terminated": terminated, "truncated": truncated, "final_observation": final}
    return seen, following, reward, terminated, truncated, info
