"""Tests of the interface of every memory: masks, resets, gradients, and single steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.agents.memory import check_memory
from rtd3jax.registries import MEMORIES
from rtd3jax.training.jobs import make_jobs

TOKENS, BATCH, WIDTH = 6, 4, 5
BUILT_IN = ("lstm", "gru", "min-gru")
STARTS = jnp.zeros((TOKENS, BATCH), bool).at[0].set(True).at[2, 1].set(True).at[5, 2].set(True)


@pytest.fixture
def float64():
    with jax.enable_x64(True):
        yield


def _problem(name, dtype=jnp.float32):
    memory = MEMORIES[name](inputs=WIDTH, width=WIDTH)
    params = jax.tree.map(lambda x: 2 * x.astype(dtype), memory.initial(jax.random.key(0)))
    tokens = jax.random.normal(jax.random.key(1), (TOKENS, BATCH, WIDTH), dtype)
    return memory, params, tokens


def _one_by_one(memory, params, tokens, starts, carry=None):
    """Outputs and last carry as one would write it down: a step after the other."""
    carry = memory.zero(BATCH) if carry is None else carry
    carry = jax.tree.map(lambda part: part.astype(tokens.dtype), carry)
    outputs = []
    for token, begins in zip(tokens, starts, strict=True):
        carry = jax.tree.map(lambda part, b=begins: jnp.where(b[:, None], 0 * part, part), carry)
        carry = memory.apply({"params": params}, carry, token, method="step")
        outputs.append(memory.apply({"params": params}, carry, method="read"))
    return jnp.stack(outputs), carry


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_scan_is_one_step_after_another_with_resets(name):
    memory, params, tokens = _problem(name)
    outputs, end = memory.apply({"params": params}, None, tokens, STARTS, method="scan")
    expected, last = _one_by_one(memory, params, tokens, STARTS)
    np.testing.assert_allclose(outputs, expected, atol=1e-6)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), end, last)
    without, _ = _one_by_one(memory, params, tokens, jnp.zeros_like(STARTS))
    assert not np.allclose(outputs[2, 1], without[2, 1])  # the reset shows


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_scan_goes_on_from_a_carry(name):
    memory, params, tokens = _problem(name)
    never = jnp.zeros_like(STARTS)
    whole, _ = memory.apply({"params": params}, None, tokens, never, method="scan")
    _, carry = memory.apply({"params": params}, None, tokens[:3], never[:3], method="scan")
    rest, _ = memory.apply({"params": params}, carry, tokens[3:], never[3:], method="scan")
    np.testing.assert_allclose(rest, whole[3:], atol=1e-6)


@pytest.mark.parametrize("name", BUILT_IN)
def test_tokens_that_do_not_exist_leave_no_trace(name):
    memory, params, tokens = _problem(name)
    lengths = jnp.array([0, 1, 4, TOKENS])
    exists = jnp.arange(TOKENS, 0, -1)[:, None] <= lengths[None, :]
    garbage = jnp.where(exists[:, :, None], tokens, 1e3)
    end, same = (
        memory.apply({"params": params}, None, x, exists, method="end") for x in (tokens, garbage)
    )
    for a, b in zip(jax.tree.leaves(end), jax.tree.leaves(same), strict=True):
        np.testing.assert_array_equal(a, b)
        assert not np.any(a[0])
    for column, length in enumerate(lengths.tolist()):
        if length:
            short = tokens[TOKENS - length :]
            _, expected = _one_by_one(memory, params, short, jnp.zeros_like(STARTS[:length]))
            for a, b in zip(jax.tree.leaves(end), jax.tree.leaves(expected), strict=True):
                np.testing.assert_allclose(a[column], b[column], atol=1e-6)


@pytest.mark.parametrize("name", BUILT_IN)
def test_gradients_are_those_of_one_step_after_another(float64, name):
    memory, params, tokens = _problem(name, jnp.float64)
    weights = jax.random.normal(jax.random.key(2), (TOKENS, BATCH, WIDTH), jnp.float64)
    start = jax.tree.map(
        lambda part: jnp.full_like(part, 0.3, dtype=jnp.float64), memory.zero(BATCH)
    )
    starts = STARTS.at[0, 0].set(False)  # so that one column depends on the first carry

    def loss(run):
        def of(params, tokens, start):
            outputs, end = run(params, tokens, start)
            return jnp.sum(weights * outputs) + sum(
                jnp.sum(part**2) for part in jax.tree.leaves(end)
            )

        return jax.jit(jax.grad(of, argnums=(0, 1, 2)))(params, tokens, start)

    fast = loss(lambda p, x, c: memory.apply({"params": p}, c, x, starts, method="scan"))
    slow = loss(lambda p, x, c: _one_by_one(memory, p, x, starts, c))
    for a, b in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)
        assert np.any(b)


class _Lag(rtd.Memory):
    """The last token, half remembered: a memory of a user's own, without parameters."""

    def zero(self, batch):
        return {"now": jnp.zeros((batch, self.width))}

    def step(self, carry, token):
        return {"now": 0.5 * carry["now"] + token}

    def read(self, carry):
        return jnp.tanh(carry["now"])


class _Wide(_Lag):
    def read(self, carry):
        return jnp.concatenate((carry["now"], carry["now"]), axis=-1)


class _Grows(_Lag):
    def step(self, carry, token):
        return {"now": token, "before": carry["now"]}


class _Whole(_Lag):
    def zero(self, batch):
        return {"now": jnp.zeros((batch, self.width), jnp.int32)}


class _Ones(_Lag):
    def zero(self, batch):
        return {"now": jnp.ones((batch, self.width))}


class _Fails(_Lag):
    def step(self, carry, token):
        raise RuntimeError("out of order")


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (_Wide, r"read must return float32 \[batch, 5\], not float32\[2, 10\]"),
        (_Grows, r"step must return a carry like zero's.*float32\[2, 5\]"),
        (_Whole, r"zero\(batch\) must return float32 arrays.*not int32\[2, 5\]"),
        (_Ones, "zero must return zeros"),
        (_Fails, "failed in initial, step or read: out of order"),
    ],
)
def test_what_does_not_keep_to_the_interface_is_one_line(module, message):
    check_memory("lag", _Lag(inputs=WIDTH, width=WIDTH))
    with pytest.raises(rtd.UserError, match=message):
        check_memory("mine", module(inputs=WIDTH, width=WIDTH))


def test_names_are_taken_once_and_modules_are_memories():
    with pytest.raises(rtd.UserError, match="memory 'lstm' is already registered.*replace=True"):
        rtd.register_memory("lstm", _Lag)
    with pytest.raises(rtd.UserError, match="must be a subclass of rtd.Memory"):
        rtd.register_memory("dict", dict)
    with pytest.raises(rtd.UserError, match="is not a valid name"):
        rtd.register_memory("two words", _Lag)
    with pytest.raises(rtd.UserError, match="memory 'lsmt' is unknown; did you mean 'lstm'"):
        rtd.Config(memory="lsmt")


def test_a_memory_that_replaces_another_takes_effect_at_once():
    class Doubled(MEMORIES["gru"]):
        def read(self, carry):
            return 2.0 * super().read(carry)

    env, returns = rtd.make("rover", "ar1-slip"), []
    for module in (MEMORIES["gru"], Doubled):
        rtd.register_memory("own", module, replace=True)
        config = rtd.Config("lstm-td3", 1, memory="own", hidden_size=4)
        (job,) = make_jobs(env, config, [0])
        policy = job.program.policy(job.lane, jax.jit(job.program.init)(job.lane))
        returns.append(rtd.evaluate(policy, env, episodes=2))
    assert not np.array_equal(*returns)
