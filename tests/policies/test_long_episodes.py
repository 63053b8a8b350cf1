"""Tests that a policy can act for longer than its counter of steps can count."""

import jax.numpy as jnp
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.policies.trained import _LONG
from rtd3jax.training.jobs import make_jobs

TINY = dict(total_steps=20, learning_starts=10, batch_size=4, hidden_size=4, eval_every=20)


@pytest.mark.parametrize("length", [1, 3, 5])
def test_the_counter_starts_again_without_an_effect(length):
    config = rtd.Config("lstm-td3", history_length=length, **TINY)
    (job,) = make_jobs(rtd.make("rover", "ar1-slip"), config, [0])
    policy = job.program.policy(job.lane, job.program.init(job.lane))
    observations = np.random.default_rng(0).normal(size=(length + 12, 2)).astype(np.float32)
    state = policy.init()
    for seen in observations[: length + 4]:
        _, state = policy.step(state, seen)
    # The same slots of the ring, three steps before the counter starts again.
    late = _LONG - 3 - (_LONG - 3 - int(state.time)) % policy.ring_size
    ahead = state.replace(time=jnp.int32(late))
    for seen in observations[length + 4 :]:
        action, state = policy.step(state, seen)
        again, ahead = policy.step(ahead, seen)
        np.testing.assert_array_equal(action, again)
    assert policy.ring_size <= ahead.time < 3 * policy.ring_size + 10
