"""Compares the fast LSTM with the straightforward one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtd3jax.agents.memory.lstm import (
    Carry,
    init_lstm,
    lstm,
    reference,
    zero_carry,
)

TOKENS, BATCH, INPUTS, WIDTH = 5, 4, 3, 6


def _problem(dtype):
    keys = jax.random.split(jax.random.key(0), 4)
    params = jax.tree.map(lambda x: x.astype(dtype), init_lstm(keys[0], INPUTS, WIDTH))
    inputs = jax.random.normal(keys[1], (TOKENS, BATCH, INPUTS), dtype)
    lengths = jnp.array([0, 1, 3, 5])
    exists = jnp.arange(TOKENS, 0, -1)[:, None] <= lengths[None, :]
    weights = jax.random.normal(keys[2], (2, BATCH, WIDTH), dtype)
    return params, inputs, exists, weights


@pytest.fixture
def float64():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("tokens", [1, 2, TOKENS])
@pytest.mark.parametrize("start", [None, zero_carry(BATCH, WIDTH)])
def test_forward_equals_reference(tokens, start):
    params, inputs, exists, _ = _problem(jnp.float32)
    inputs, exists = inputs[-tokens:], exists[-tokens:]
    slow = reference(params, inputs, exists, zero_carry(BATCH, WIDTH))
    for a, b in zip(lstm(params, inputs, exists, start), slow, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("start", [None, zero_carry(BATCH, WIDTH)])
def test_a_window_without_tokens_leaves_the_carry_zero(start):
    params, inputs, exists, _ = _problem(jnp.float32)
    hidden, cell = lstm(params, inputs, exists, start)
    assert not np.any(hidden[0]) and not np.any(cell[0])
    assert np.all(hidden[1] != 0)


def test_masked_tokens_do_not_matter():
    params, inputs, exists, _ = _problem(jnp.float32)
    start = zero_carry(BATCH, WIDTH)
    garbage = jnp.where(exists[:, :, None], inputs, 1e3)
    for a, b in zip(
        lstm(params, inputs, exists, start), lstm(params, garbage, exists, start), strict=True
    ):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("from_zero", [True, False])
@pytest.mark.parametrize("implied", [True, False])
def test_gradient_equals_automatic_differentiation(float64, from_zero, implied):
    if implied and not from_zero:
        pytest.skip("only a zero carry is implied")
    params, inputs, exists, weights = _problem(jnp.float64)
    start = Carry(*(weights * (0.0 if from_zero else 1.0)))
    if not from_zero:  # a stored carry is followed by tokens that all exist
        exists = jnp.ones_like(exists)

    def loss(function):
        def of(params, inputs, start):
            carry = None if implied and function is lstm else start
            end = function(params, inputs, exists, carry)
            return jnp.sum(end.hidden * weights[0]) + jnp.sum(end.cell * weights[1] ** 2)

        reads = (0, 1) if from_zero else (0, 1, 2)
        return jax.jit(jax.grad(of, argnums=reads))(params, inputs, start)

    fast, slow = loss(lstm), loss(reference)
    for a, b in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)
