"""Converts an agent's actions, in half ranges, to the environment's units."""

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Bounds:
    """The range of the environment's action in its units. ``low`` and ``high``: [A]."""

    low: jax.Array
    high: jax.Array

    @property
    def half_range(self) -> jax.Array:
        """Half the distance between the bounds: [A]; the unit of the agent's actions."""
        return 0.5 * self.high - 0.5 * self.low

    @property
    def centre(self) -> jax.Array:
        """The middle of the range: [A]."""
        return 0.5 * self.high + 0.5 * self.low

    def to_environment(self, action: jax.Array) -> jax.Array:
        """Convert ``action`` [A], in half ranges from the centre, to the environment's units.

        The result lies within the bounds, even if rounding would exceed them.
        """
        return jnp.clip(self.centre + self.half_range * action, self.low, self.high)
