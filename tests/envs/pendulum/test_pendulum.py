"""Compares the pendulum with Gymnasium's, and tests its reward for an observation."""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtd3jax.envs.pendulum.environment import Pendulum, PendulumState

STEPS = 1000


@pytest.fixture(scope="module")
def reference():
    """1,000 single steps of Gymnasium's Pendulum-v1 from random states with random torques."""
    random = np.random.default_rng(0)
    theta = random.uniform(-3 * np.pi, 3 * np.pi, STEPS).astype(np.float32)
    theta_dot = random.uniform(-8, 8, STEPS).astype(np.float32)
    # Beyond the bounds too, so that clipping is compared.
    action = random.uniform(-3, 3, (STEPS, 1)).astype(np.float32)
    env = gymnasium.make("Pendulum-v1").unwrapped
    env.reset(seed=0)
    after, rewards, observations = [], [], []
    for index in range(STEPS):
        env.state = np.array([theta[index], theta_dot[index]], np.float64)
        observation, reward, *_ = env.step(action[index].astype(np.float64))
        after.append(env.state)
        rewards.append(reward)
        observations.append(observation)
    return theta, theta_dot, action, np.array(after), np.array(rewards), np.array(observations)


@pytest.fixture(scope="module")
def ours(reference):
    theta, theta_dot, action, *_ = reference
    env = Pendulum()
    states = PendulumState(
        theta=jnp.asarray(theta),
        theta_dot=jnp.asarray(theta_dot),
        last_u=jnp.zeros(STEPS),
        time=jnp.zeros(STEPS, jnp.int32),
    )
    step = jax.jit(jax.vmap(functools.partial(env.step_env, params=env.default_params)))
    return step(jax.random.split(jax.random.key(0), STEPS), states, jnp.asarray(action))


def test_states_are_gymnasiums(reference, ours):
    _, _, _, after, _, observations = reference
    observation, state, *_ = ours
    np.testing.assert_allclose(state.theta, after[:, 0], rtol=2e-6, atol=2e-6)
    np.testing.assert_allclose(state.theta_dot, after[:, 1], rtol=2e-6, atol=2e-6)
    np.testing.assert_allclose(observation, observations, atol=5e-6)


def test_rewards_are_gymnasiums(reference, ours):
    np.testing.assert_allclose(ours[2], reference[4], rtol=2e-6, atol=1e-5)


def test_it_never_terminates_and_is_truncated_after_200_steps():
    env = Pendulum()
    params = env.default_params

    def body(carry, key):
        _, state, _, terminated, truncated, _ = env.step(key, carry, jnp.zeros(1), params)
        return state, (terminated, truncated)

    _, state = env.reset(jax.random.key(0), params)
    keys = jax.random.split(jax.random.key(1), 400)
    _, (terminated, truncated) = jax.jit(lambda s, k: jax.lax.scan(body, s, k))(state, keys)
    assert not np.any(terminated)
    assert list(np.flatnonzero(truncated)) == [199, 399]


def test_starts_are_uniform():
    env = Pendulum()
    reset = jax.jit(jax.vmap(lambda key: env.reset_env(key, env.default_params)[1]))
    state = reset(jax.random.split(jax.random.key(0), 4000))
    for value, bound in ((np.asarray(state.theta), np.pi), (np.asarray(state.theta_dot), 1.0)):
        assert np.all(np.abs(value) <= bound)
        # Kolmogorov-Smirnov distance; 1.95/sqrt(n) is exceeded once in a thousand times.
        empirical = (np.arange(4000) + 0.5) / 4000
        assert np.max(np.abs((np.sort(value) / bound + 1) / 2 - empirical)) < 1.95 / np.sqrt(4000)


def test_reward_of_a_true_observation_is_the_reward(reference):
    theta, theta_dot, action, _, rewards, _ = reference
    env = Pendulum()
    seen = jnp.stack([jnp.cos(theta), jnp.sin(theta), jnp.asarray(theta_dot)], axis=1)
    observed = jax.jit(jax.vmap(lambda o, a: env.observed_reward(o, a, env.default_params)))
    np.testing.assert_allclose(observed(seen, jnp.asarray(action)), rewards, atol=3e-5)


def test_observed_reward_ignores_the_length_of_the_direction():
    env = Pendulum()
    reward = env.observed_reward(jnp.array([0.0, 3.0, 1.0]), jnp.array([5.0]), env.default_params)
    assert float(reward) == pytest.approx(-((np.pi / 2) ** 2 + 0.1 + 0.001 * 4.0))
