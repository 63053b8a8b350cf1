"""A choice between arrays for each of their rows."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike


def where_rows(rows: jax.Array, chosen: ArrayLike, otherwise: jax.Array) -> jax.Array:
    """``jnp.where`` with a condition for the leading axes only.

    Args:
        rows: bool [B...].
        chosen: [B..., ...] or a number, for the rows that are true.
        otherwise: [B..., ...], for the others.
    """
    axes = (1,) * (otherwise.ndim - rows.ndim)
    return jnp.where(rows.reshape(*rows.shape, *axes), chosen, otherwise)
