"""Noise on actions, for exploration and for the actor's objective (``actor_noise``)."""

import jax
import jax.numpy as jnp


def add_noise(key: jax.Array, action: jax.Array, scale: jax.Array) -> jax.Array:
    """``action`` [B, A] with Gaussian noise of standard deviation ``scale`` [], within [-1, 1]."""
    gaussian = jax.random.normal(key, action.shape, jnp.float32)
    return jnp.clip(action + scale * gaussian, -1.0, 1.0)
