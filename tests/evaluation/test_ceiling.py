"""Tests the rover's optimal policy: moments, inference, and comparison with its neighbours."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import rtd3jax as rtd
from rtd3jax.envs.rover.environment import RoverParams
from rtd3jax.envs.rover.optimum import best_command, clipped_normal_moments


@pytest.mark.parametrize("mean", [0.0, 0.1, 0.25, 0.45, 0.5])
@pytest.mark.parametrize("deviation", [0.02, 0.1, 0.4])
def test_moments_equal_quadrature(mean, deviation):
    grid = stats.norm.ppf((np.arange(200_000) + 0.5) / 200_000, mean, deviation).clip(0, 0.5)
    got = clipped_normal_moments(*map(jnp.float32, (mean, deviation, 0.5)))
    np.testing.assert_allclose(got, (grid.mean(), (grid**2).mean()), atol=2e-6)


@pytest.mark.parametrize("mean", [-0.1, 0.3, 0.7])
def test_moments_without_noise_are_those_of_a_number(mean):
    got = clipped_normal_moments(*map(jnp.float32, (mean, 0.0, 0.5)))
    value = min(max(mean, 0.0), 0.5)
    np.testing.assert_allclose(got, (value, value**2), rtol=1e-6)


@pytest.mark.parametrize(
    "task",
    [
        {},
        {"target_speed": 0.9},
        {"target_speed": 0.9, "target_yaw_rate": -0.8},
        {"target_speed": 0.2, "max_yaw_rate": 0.05, "target_yaw_rate": 0.3},
    ],
)
@pytest.mark.parametrize("slips", [(0.1, 0.2), (0.45, 0.1), (0.6, 0.75)])
def test_no_command_within_the_bounds_is_better(task, slips):
    params, deviation, draws = RoverParams(**task), 0.05, 4_000
    traction = 1 - np.random.default_rng(0).normal(slips, deviation, (draws, 2)).clip(0, 1)
    moments = traction.mean(0), (traction[:, :1] ** 2).mean(0), (traction[:, 1:] ** 2).mean(0)

    def loss(speed, yaw_rate):
        """Expected squared error, by the moments of independent wheels."""
        base = params.wheelbase
        left, right = speed - base / 2 * yaw_rate, speed + base / 2 * yaw_rate
        squares = moments[1] * left**2 + moments[2] * right**2
        product = moments[0][0] * moments[0][1] * left * right
        means = moments[0][0] * left, moments[0][1] * right
        v, w = sum(means) / 2, (means[1] - means[0]) / base
        v2, w2 = (squares + 2 * product) / 4, (squares - 2 * product) / base**2
        targets = params.target_speed, params.target_yaw_rate
        return v2 - 2 * targets[0] * v + w2 - 2 * targets[1] * w

    limit = params.max_speed, params.max_yaw_rate
    grid = np.meshgrid(*(np.linspace(-bound, bound, 801) for bound in limit))
    least = loss(*grid).min()
    second = np.concatenate(moments[1:])
    command = best_command(params, *map(jnp.float32, (moments[0], second)))
    assert np.all(np.abs(command) <= np.asarray(limit, np.float32))
    assert loss(*np.asarray(command, np.float64)) == pytest.approx(least, abs=1e-5)


def test_the_slip_is_inferred_from_a_command_at_its_bound():
    env = rtd.make("rover", disturbance="ar1-slip", target_speed=1.5)
    policy = rtd.bayes_policy(env)
    observation, state = env.reset(jax.random.key(3))
    met = state.slip.slip
    action, memory = policy.step(policy.init(), observation)
    assert float(action[0]) == 1.0
    observation, *_ = env.step(jax.random.key(0), state, action)
    _, after = policy.step(memory, observation)
    np.testing.assert_allclose(after.slip, met, atol=1e-5)


def test_the_slip_is_inferred_exactly():
    env = rtd.make("rover", disturbance="ar1-slip")
    policy = rtd.bayes_policy(env)
    observation, state = env.reset(jax.random.key(3))
    memory = policy.init()
    for step in range(5):
        met = state.slip.slip
        action, memory = policy.step(memory, observation)
        observation, state, *_ = env.step(jax.random.key(step), state, action)
        _, after = policy.step(memory, observation)
        np.testing.assert_allclose(after.slip, met, atol=1e-5)


def test_without_slip_the_best_return_is_zero():
    best = rtd.ceiling(rtd.make("rover"), episodes=4)
    assert best.kind == "exact" and best.mean == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    "variant",
    [
        "ar1-slip",
        pytest.param("ar1-slip-high-variance", marks=pytest.mark.slow),
        pytest.param("ar1-slip-slow", marks=pytest.mark.slow),
    ],
)
def test_no_other_model_and_no_scaled_command_does_better(variant):
    env = rtd.make("rover", disturbance=variant)
    model = env.default_params.slip
    best = rtd.evaluate(rtd.bayes_policy(env), env, episodes=2_000).mean()
    wrong = dict(rho=model.rho - 0.05), dict(sigma=model.sigma * 2), dict(sigma=model.sigma / 3)
    for change in wrong:
        policy = rtd.bayes_policy(env, dataclasses.replace(model, **change))
        assert rtd.evaluate(policy, env, episodes=2_000).mean() < best
    constant = rtd.evaluate(rtd.constant_policy([0.5, 0.0]), env, episodes=2_000).mean()
    assert constant < best - 1


def test_the_sine_bound_is_named_as_one():
    bound = rtd.ceiling(rtd.make("rover", disturbance="sine-slip"), episodes=2_000)
    assert bound.kind == "upper bound" and -0.1 < bound.mean < 0


def test_other_environments_are_refused_in_one_line():
    with pytest.raises(rtd.UserError, match="the ceiling of MountainCarContinuous-v0 is not known"):
        rtd.ceiling(rtd.make("MountainCarContinuous-v0"))
    with pytest.raises(rtd.UserError, match="moments of SineSlip are not known"):
        rtd.bayes_policy(rtd.make("rover", disturbance="sine-slip"))


def test_impossible_arguments_are_refused_and_one_episode_has_no_error():
    env = rtd.make("rover", max_steps_in_episode=3)
    for episodes in (0, 1.5, True):
        with pytest.raises(rtd.UserError, match="episodes must be an integer of at least 1"):
            rtd.ceiling(env, episodes)
    with pytest.raises(rtd.UserError, match="seed must be an integer of at least 0"):
        rtd.ceiling(env, seed=-1)
    with pytest.raises(rtd.UserError, match=r"is a name, not an environment: .* rtd.make\('rover'"):
        rtd.ceiling("rover")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for made in (env, rtd.make("rover", "sine-slip")):
            assert np.isnan(rtd.ceiling(made, 1).standard_error)


def test_the_bound_does_not_depend_on_the_default_generator():
    env = rtd.make("rover", "sine-slip")
    bound = rtd.ceiling(env, 100)
    # The number before the package's own generator was used here.
    assert bound.mean == pytest.approx(-0.02826312446661177, rel=1e-6)
    with jax.default_prng_impl("rbg"):
        assert rtd.ceiling(env, 100) == bound
