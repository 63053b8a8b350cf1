"""The border between actions in half ranges, an agent's, and those in an environment's units."""

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Bounds:
    """The range of the environment's action, in its own units. ``low`` and ``high``: [A]."""

    low: jax.Array
    high: jax.Array

    @property
    def half_range(self) -> jax.Array:
        """Half the distance between the bounds: [A]; the unit in which agents act."""
        return 0.5 * self.high - 0.5 * self.low

    @property
    def centre(self) -> jax.Array:
        """The middle of the range: [A]."""
        return 0.5 * self.high + 0.5 * self.low

    def to_environment(self, action: jax.Array) -> jax.Array:
        """An agent's ``action`` [A], in half ranges about the centre, in the environment's units.

        It is within the bounds, also where the sum is rounded.
        """
        return jnp.clip(self.centre + self.half_range * action, self.low, self.high)
