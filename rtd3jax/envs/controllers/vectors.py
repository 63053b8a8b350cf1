"""Checks of the numbers that a user passes to a controller."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from rtd3jax.errors import UserError


def vector(where: str, name: str, value: ArrayLike | Sequence[float], size: int) -> jax.Array:
    """A number or [size], as float32 [size]; UserError for anything else."""
    try:
        array = np.asarray(value, np.float32)
    except (TypeError, ValueError) as error:
        raise UserError(f"{where}: {name} must be numbers, not {value!r}") from error
    if array.shape not in ((), (size,)) or not np.isfinite(array).all():
        raise UserError(f"{where}: {name} must be a finite number or {size} of them, not {value!r}")
    return jnp.broadcast_to(jnp.asarray(array), (size,))
