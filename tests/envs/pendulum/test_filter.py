"""Compares the filter's belief with brute force, and tests the returns of its policy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.envs.pendulum import filter as pendulum_filter
from rtd3jax.envs.pendulum.belief import correct, predict, prior, sigma_points
from rtd3jax.envs.pendulum.value_iteration import swing


@pytest.fixture(autouse=True)
def coarse_grid(monkeypatch):
    monkeypatch.setattr(pendulum_filter, "ANGLES", 60)
    monkeypatch.setattr(pendulum_filter, "SPEEDS", 48)


def _posterior_moments(env, torques, observations):
    """Mean and covariance of the state, by weighing a million starts: slow and obvious."""
    angle, speed = np.meshgrid(
        np.linspace(-np.pi, np.pi, 2_000, endpoint=False), np.linspace(-1, 1, 500), indexing="ij"
    )
    fit = 0.0
    for step, seen in enumerate(np.asarray(observations)):
        expected = (np.cos(angle), np.sin(angle), speed)
        fit = fit - 2.0 * sum((o - e) ** 2 for o, e in zip(seen, expected, strict=True))
        if step < len(torques):
            params = env.default_params.env
            angle, speed, _ = map(np.asarray, swing(params, angle, speed, torques[step]))
    weight = np.exp(fit - fit.max()).ravel()
    states = np.stack((np.cos(angle), np.sin(angle), speed), -1).reshape(-1, 3)
    return np.average(states, axis=0, weights=weight), np.cov(states.T, aweights=weight)


@functools.cache
def of_noise():
    return rtd.filter_policy(rtd.make("pendulum", "noise"))


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))]
)
@pytest.mark.parametrize("steps", [0, 8])
def test_the_belief_is_the_posterior_of_a_million_starts(seed, steps):
    env = rtd.make("pendulum", "noise")  # sigma 0.5: twice the squared distance is -log p
    policy = of_noise()
    params = env.default_params.env
    observation, state = env.reset(jax.random.key(seed))
    seen, torques = [observation], np.random.default_rng(seed).uniform(-2, 2, steps)
    belief = prior(policy.sensor, observation, *policy.cells)
    belief = correct(belief, policy.sensor, policy.sensor.first, observation)
    for step, torque in enumerate(torques):
        action = jnp.asarray([torque], jnp.float32)
        observation, state, *_ = env.step(jax.random.key(100 + step), state, action)
        seen.append(observation)
        belief = predict(belief, policy.sensor, params, jnp.float32(torque))
        belief = correct(belief, policy.sensor, policy.sensor.later, observation)
    weight, points = map(np.asarray, sigma_points(belief))
    assert weight.sum() == pytest.approx(1, abs=1e-4)
    states = np.stack((np.cos(points[:, 0]), np.sin(points[:, 0]), points[:, 1]), -1)
    mean, covariance = _posterior_moments(env, torques, seen)
    np.testing.assert_allclose(np.average(states, axis=0, weights=weight), mean, atol=0.06)
    spread = np.sqrt(np.diag(np.cov(states.T, aweights=weight, ddof=0)))
    np.testing.assert_allclose(spread, np.sqrt(np.diag(covariance)), rtol=0.25, atol=0.02)


@pytest.mark.parametrize(
    ("disturbance", "most"),
    [
        ("hidden", 0.5),
        *(pytest.param(n, 3.0, marks=pytest.mark.slow) for n in ("temporal-sine", "random-sine")),
    ],
)
def test_what_determines_the_state_costs_nothing(disturbance, most, monkeypatch):
    monkeypatch.setattr(pendulum_filter, "ANGLES", 40)  # both returns are of the same values
    monkeypatch.setattr(pendulum_filter, "SPEEDS", 32)
    env, plain = rtd.make("pendulum", disturbance), rtd.make("pendulum")
    returns = rtd.evaluate(rtd.filter_policy(env), env, 40)
    known = rtd.evaluate(rtd.filter_policy(plain), plain, 40)
    assert abs(float(jnp.mean(returns - known))) < most


def test_under_noise_it_earns_most_of_what_there_is():
    env = rtd.make("pendulum", "noise")
    returns = rtd.evaluate(of_noise(), env, 40, true_reward=True)
    assert -350 < float(jnp.mean(returns)) < -150


def test_other_environments_are_refused_in_one_line():
    with pytest.raises(rtd.UserError, match="only known for the pendulum"):
        rtd.filter_policy(rtd.make("rover"))
    with pytest.raises(rtd.UserError, match="does not cover this Pulses"):
        rtd.filter_policy(rtd.make("pendulum", "temporal-bias"))
    noise = rtd.GaussianNoise(np.array([0.1, 0.1, 0.5]))
    with pytest.raises(rtd.UserError, match="the same sigma for all elements"):
        rtd.filter_policy(rtd.disturb(rtd.make("pendulum"), noise))
    for g in (-1.0, 0.0):
        with pytest.raises(rtd.UserError, match=f"g={g} must be greater than 0"):
            rtd.filter_policy(rtd.make("pendulum", "noise", g=g))
