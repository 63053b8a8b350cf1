"""The pendulum's ceiling: converged on its grid, and reached by acting greedily upon it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.value_iteration import TORQUES, interpolate, mean_optimal_return, optimal_value

ANGLES, SPEEDS = 200, 160


def _params():
    return rtd.make("pendulum").default_params.env


@pytest.mark.slow
def test_halving_the_grid_moves_the_mean_by_less_than_0_3():
    coarse, _ = mean_optimal_return(_params(), 20_000, 0, ANGLES, SPEEDS)
    fine, error = mean_optimal_return(_params(), 20_000, 0, 2 * ANGLES, 2 * SPEEDS)
    assert abs(fine - coarse) < 0.3
    assert error == pytest.approx(0.52, abs=0.05)


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


def test_looking_one_step_ahead_with_these_values_reaches_them_in_the_real_world():
    """gymnax's own step, not ours: the dynamics that were solved are those that are played."""
    env, params = rtd.make("pendulum").base, _params()
    value, top = optimal_value(params, ANGLES, SPEEDS)
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
    from rtd3jax import ceilings

    monkeypatch.setattr(ceilings, "mean_optimal_return", lambda *_: (-136.0, 0.5))
    assert rtd.ceiling(rtd.make("pendulum")).kind == "exact"
    assert rtd.ceiling(rtd.make("pendulum", "random-sine")).kind == "upper bound"
    with pytest.raises(rtd.UserError, match="itself disturbed has no known ceiling"):
        rtd.ceiling(rtd.make("pendulum", "noise"))
    assert rtd.ceiling(rtd.make("pendulum", "noise", reward_from="state")).mean == -136.0
