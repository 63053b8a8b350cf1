"""Tests that learning does not depend on the unit and the centre of actions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from follow import Follow, Params

import rtd3jax as rtd

ENV = Follow()


def _trained(centre, half_range, algorithm):
    config = rtd.Config(
        algorithm=algorithm,
        history_length=None if algorithm == "td3" else 2,
        total_steps=600,
        hidden_size=16,
        batch_size=32,
        learning_starts=100,
        eval_every=200,
        eval_episodes=5,
    )
    params = Params(centre=jnp.float32(centre), half_range=jnp.float32(half_range))
    return params, rtd.train(ENV, config, seeds=[0], params=params, progress=False)


@pytest.mark.parametrize(
    "algorithm", ["lstm-td3", *(pytest.param(n, marks=pytest.mark.slow) for n in ("td3", "h-td3"))]
)
def test_the_unit_of_the_actions_does_not_matter(algorithm):
    _, run = _trained([0, 0], [1, 1], algorithm)
    # Powers of two are exact: the same to the bit, also where elements differ by 2**20.
    for half_range in ([2.0**-10, 2.0**10], [2.0**20, 1.0]):
        _, other = _trained([0, 0], half_range, algorithm)
        np.testing.assert_array_equal(other.returns, run.returns)
        leaves = (jax.tree.leaves(r.policy(0).actor) for r in (run, other))
        for one, two in zip(*leaves, strict=True):
            np.testing.assert_array_equal(one, two)


def test_neither_does_the_centre():
    _, run = _trained([0, 0], [1, 1], "lstm-td3")
    env, other = _trained([100, 0.3], [1, 0.3], "lstm-td3")
    assert run.returns[0, -1] > 0.5 * run.returns[0, 0]  # it learns
    np.testing.assert_allclose(other.returns, run.returns, rtol=1e-2)
    policy, expected = other.policy(0), run.policy(0)
    state, expected_state = policy.init(), expected.init()
    for observation in np.random.default_rng(0).uniform(-1, 1, (5, 3)).astype(np.float32):
        action, state = policy.step(state, observation)
        want, expected_state = expected.step(expected_state, observation)
        half_ranges = (np.asarray(action) - env.centre) / env.half_range
        np.testing.assert_allclose(half_ranges, want, atol=2e-2)
