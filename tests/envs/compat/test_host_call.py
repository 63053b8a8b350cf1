"""The host is asked once for all that stand side by side, whichever way leads to it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtd3jax.envs.compat import host_call as module
from rtd3jax.envs.compat.host_call import host_call

SHAPES = ((), jnp.uint32), ((2,), jnp.float32), ((), jnp.bool_)


def answers(number, vector):
    """What the host says to a uint32 [] and a float32 [2]."""
    return int(number) + 1, 2.0 * vector, bool(vector[0] > 3.0)


@pytest.fixture(params=["in place", "copied"])
def asked(request, monkeypatch):
    """A call of the host within a program, and how often the host was asked."""
    if request.param == "copied":  # as on an accelerator
        monkeypatch.setattr(
            module.jax.lax, "platform_dependent", lambda *given, cpu, default: default(*given)
        )
    count = []

    def host(number, vector):
        count.append(1)
        assert isinstance(vector, np.ndarray) and vector.dtype == np.float32
        return answers(number, vector)

    def call(number, vector, due=None):
        return host_call(host, SHAPES, due, number, vector)

    return call, count


def test_one_and_many_are_answered_alike(asked):
    call, count = asked
    numbers = jnp.arange(6, dtype=jnp.uint32).reshape(2, 3) + jnp.uint32(2**32 - 7)
    vectors = jnp.arange(12, dtype=jnp.float32).reshape(2, 3, 2)
    one = jax.jit(call)(numbers[0, 0], vectors[0, 0])
    many = jax.jit(jax.vmap(jax.vmap(call)))(numbers, vectors)
    jax.block_until_ready((one, many))
    assert len(count) == 7
    for i in range(2):
        for j in range(3):
            number, vector = np.asarray(numbers)[i, j], np.asarray(vectors)[i, j]
            expected = int(number) + 1, 2.0 * vector, vector[0] > 3.0
            for found, value, (shape, dtype) in zip(many, expected, SHAPES, strict=True):
                assert found.dtype == dtype and found.shape == (2, 3, *shape)
                np.testing.assert_array_equal(np.asarray(found)[i, j], np.asarray(value))
    for found, alone in zip(many, one, strict=True):
        np.testing.assert_array_equal(found[0, 0], alone)


def test_where_none_is_due_the_host_is_left_alone(asked):
    call, count = asked
    program = jax.jit(lambda number, vector: call(number, vector, due=lambda n: n > 5))
    vector = jnp.ones((2,), jnp.float32)
    for number in (2, 7):
        found = jax.block_until_ready(program(jnp.uint32(number), vector))
        assert len(count) == (number > 5)
        assert int(found[0]) == (8 if number > 5 else 0)


def test_on_a_cpu_nothing_is_copied_to_a_device():
    program = jax.jit(lambda number: host_call(lambda n: (n,), (((), jnp.int32),), None, number))
    text = program.lower(jnp.int32(1)).as_text()
    assert "xla_buffer_python_cpu_callback" in text and text.count("custom_call @") == 1
