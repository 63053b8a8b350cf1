"""Matrix products in a chosen precision, forward and backward.

With ``bfloat16``, the factors of a product are rounded to 8 bits of mantissa. Its sums, and all
stored values (parameters, gradients, carries), stay in float32. On processors with bfloat16 units,
such a product takes a fraction of the time of a float32 product.
"""

import functools

import jax
import jax.numpy as jnp


def narrow(x: jax.Array, precision: str) -> jax.Array:
    """``x`` as a factor of a product: rounded to ``bfloat16``, or unchanged."""
    return x.astype(jnp.bfloat16) if precision == "bfloat16" else x


def product(x: jax.Array, y: jax.Array) -> jax.Array:
    """``x @ y`` for factors of the same precision, summed in float32 at least."""
    return jnp.dot(x, y, preferred_element_type=jnp.float32 if _is_narrow(x) else x.dtype)


def weight_gradient(x: jax.Array, gradient: jax.Array) -> jax.Array:
    """The sum of ``x.T @ gradient`` over tokens: [I, O] from [T, B, I] and [T, B, O]."""
    flat = gradient.reshape(-1, gradient.shape[-1])
    if not _is_narrow(x):
        return product(x.reshape(-1, x.shape[-1]).T, flat)
    # XLA's CPU backend has no bfloat16 product of a transposed factor: it would silently use the
    # float32 product. So the factor is transposed explicitly, in two steps that fit in the cache;
    # the barriers keep XLA from merging the steps.
    barrier = jax.lax.optimization_barrier
    by_token = barrier(jnp.swapaxes(x, 1, 2))
    transposed = barrier(jnp.swapaxes(by_token, 0, 1)).reshape(x.shape[-1], -1)
    return product(transposed, barrier(flat))


def _is_narrow(x: jax.Array) -> bool:
    return x.dtype == jnp.bfloat16


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def matmul(x: jax.Array, kernel: jax.Array, precision: str) -> jax.Array:
    """``x @ kernel`` [B, O] for float32 [B, I] and [I, O]; its gradients are float32 too."""
    return product(narrow(x, precision), narrow(kernel, precision))


def _forward(x, kernel, precision):
    x, kernel = narrow(x, precision), narrow(kernel, precision)
    return product(x, kernel), (x, kernel)


def _backward(precision, factors, gradient):
    x, kernel = factors
    gradient = narrow(gradient, precision)
    return product(gradient, kernel.T), weight_gradient(x[None], gradient[None])


matmul.defvjp(_forward, _backward)
