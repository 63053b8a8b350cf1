"""Tests that bfloat16 products only round their factors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtd3jax.agents.memory.lstm import Carry, init_lstm, lstm, reference
from rtd3jax.agents.products import matmul, weight_gradient


def _rounded(x):
    return np.asarray(jnp.asarray(x).astype(jnp.bfloat16).astype(jnp.float32), np.float64)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_product_and_gradients_are_those_of_rounded_factors(precision):
    keys = jax.random.split(jax.random.key(0), 3)
    x, kernel, gradient = (
        jax.random.normal(k, s) for k, s in zip(keys, ((5, 7), (7, 3), (5, 3)), strict=True)
    )
    y, pull = jax.vjp(lambda x, kernel: matmul(x, kernel, precision), x, kernel)
    d_x, d_kernel = pull(gradient)
    number = _rounded if precision == "bfloat16" else np.asarray
    np.testing.assert_allclose(y, number(x) @ number(kernel), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(d_x, number(gradient) @ number(kernel).T, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(d_kernel, number(x).T @ number(gradient), rtol=1e-5, atol=1e-6)
    assert {a.dtype for a in (y, d_x, d_kernel)} == {jnp.dtype("float32")}


def test_weight_gradients_sum_over_tokens():
    x = jax.random.normal(jax.random.key(1), (3, 5, 7)).astype(jnp.bfloat16)
    gradient = jax.random.normal(jax.random.key(2), (3, 5, 4)).astype(jnp.bfloat16)
    expected = np.einsum("tbi,tbo->io", _rounded(x), _rounded(gradient))
    np.testing.assert_allclose(weight_gradient(x, gradient), expected, rtol=1e-5, atol=1e-5)


def test_an_lstm_in_bfloat16_is_near_the_reference_and_not_equal():
    params = init_lstm(jax.random.key(3), 8, 8)
    inputs = jax.random.normal(jax.random.key(4), (6, 5, 8))
    exists = jnp.arange(6)[:, None] >= jnp.array([0, 1, 3, 5, 6])[None, :]
    zero = Carry(jnp.zeros((5, 8)), jnp.zeros((5, 8)))

    def loss(run, *rest):
        return lambda p, x: jnp.sum(jnp.sin(run(p, x, exists, zero, *rest).hidden))

    for argument in (0, 1):
        exact = jax.grad(loss(reference), argument)(params, inputs)
        rough = jax.grad(loss(lstm, "bfloat16"), argument)(params, inputs)
        for a, b in zip(jax.tree.leaves(exact), jax.tree.leaves(rough), strict=True):
            assert b.dtype == jnp.float32
            scale = float(jnp.abs(a).max())
            assert 1e-5 * scale < float(jnp.abs(a - b).max()) < 2e-2 * scale
