"""Tests the pendulum's ceiling: it has converged, and the greedy policy reaches it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.envs.pendulum.value_iteration import ANGLES as ANGLES_USED
from rtd3jax.envs.pendulum.value_iteration import SPEEDS as SPEEDS_USED
from rtd3jax.envs.pendulum.value_iteration import (
    TORQUES,
    interpolate,
    mean_optimal_return,
    mean_over_starts,
    optimal_value,
    optimal_values,
)

ANGLES, SPEEDS = 200, 160


def _params():
    return rtd.make("pendulum").default_params.env


def test_the_mean_over_starts_is_that_of_many_random_starts():
    """On a grid whose speeds fall between the bounds of the starts, and whose values are wild."""
    random = np.random.default_rng(0)
    value = random.normal(size=(6, 8)).astype(np.float32)
    angle = jnp.asarray(random.uniform(-np.pi, np.pi, 400_000), jnp.float32)
    speed = jnp.asarray(random.uniform(-1, 1, 400_000), jnp.float32)
    sample = np.asarray(interpolate(jnp.asarray(value), angle, speed, 2.5), np.float64)
    error = sample.std() / np.sqrt(sample.size)
    assert mean_over_starts(value, 2.5) == pytest.approx(sample.mean(), abs=4 * error)


@pytest.mark.slow
def test_the_grids_error_covers_what_a_finer_grid_says():
    """-136.98 is what 400 x 320 and 800 x 640 say; test_finer_grids_agree computes it."""
    mean, error = mean_optimal_return(_params(), ANGLES, SPEEDS)
    assert abs(mean - -136.98) < error < 2.0
    coarse = mean_over_starts(*optimal_value(_params(), ANGLES, SPEEDS))
    assert abs(coarse - -136.98) > 1.5  # extrapolating is what helps


@pytest.mark.slow
def test_finer_grids_agree():
    usual, error = mean_optimal_return(_params())
    fine, fine_error = mean_optimal_return(_params(), 2 * ANGLES_USED, 2 * SPEEDS_USED)
    assert fine == pytest.approx(-136.98, abs=0.02)
    assert abs(fine - usual) < error and fine_error < error < 0.3


def test_values_of_every_step_end_in_the_value_of_the_start():
    params = _params().replace(max_steps_in_episode=7)
    values, top = optimal_values(params, 20, 16, 8)
    assert not values[0].any()
    np.testing.assert_array_equal(values[7], optimal_value(params, 20, 16)[0])


def test_interpolation_is_exact_at_grid_points_and_periodic():
    value = jnp.asarray(np.random.default_rng(0).normal(size=(8, 5)), jnp.float32)
    angle = -np.pi + 2 * np.pi * np.arange(8, dtype=np.float32) / 8
    speed = np.linspace(-2, 2, 5, dtype=np.float32)
    for turn in (0.0, 2 * np.pi, -2 * np.pi):
        at = interpolate(value, jnp.asarray(angle[:, None] + turn), jnp.asarray(speed)[None], 2.0)
        np.testing.assert_allclose(at, value, atol=1e-4)
    between = interpolate(value, jnp.float32(angle[7] + np.pi / 8), jnp.float32(0.5), 2.0)
    corners = value[jnp.array([7, 7, 0, 0]), jnp.array([2, 3, 2, 3])]
    np.testing.assert_allclose(between, corners.mean(), atol=1e-5)


@pytest.mark.slow
def test_looking_one_step_ahead_with_these_values_reaches_them_in_the_real_world():
    """gymnax's own step, not ours: the dynamics that were solved are those that are played."""
    env, params = rtd.make("pendulum").base, _params()
    value, top = optimal_value(params, ANGLES // 2, SPEEDS // 2)
    value, torques = jnp.asarray(value), jnp.linspace(-2.0, 2.0, TORQUES)

    def episode(key):
        _, start = env.reset_env(key, params)

        def step(state, _):
            def outcome(torque):
                _, after, reward, *_ = env.step_env(key, state, torque[None], params)
                return after, reward

            after, rewards = jax.vmap(outcome)(torques)
            best = jnp.argmax(rewards + interpolate(value, after.theta, after.theta_dot, top))
            return jax.tree.map(lambda leaf: leaf[best], after), rewards[best]

        _, rewards = jax.lax.scan(step, start, length=200)
        return rewards.sum(), interpolate(value, start.theta, start.theta_dot, top)

    returns, promised = jax.vmap(episode)(jax.random.split(jax.random.key(1), 200))
    # Bilinear interpolation promises too little; what is reached lies a little above it.
    assert -0.5 < float(jnp.mean(returns - promised)) < 4.0


def test_the_ceiling_says_what_it_is(monkeypatch):
    from rtd3jax.envs.pendulum import optimum

    monkeypatch.setattr(optimum, "mean_optimal_return", lambda *_: (-136.0, 0.2))
    assert rtd.ceiling(rtd.make("pendulum")).kind == "exact"
    assert rtd.ceiling(rtd.make("pendulum", "random-sine")).kind == "upper bound"
    with pytest.raises(rtd.UserError, match="the ceiling under a disturbed reward is not known"):
        rtd.ceiling(rtd.make("pendulum", "noise"))
    assert rtd.ceiling(rtd.make("pendulum", "noise", reward_from="state")).mean == -136.0
