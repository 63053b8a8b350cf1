"""Compares the rover with a numpy oracle, and with facts in the paper."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import rtd3jax as rtd
from rtd3jax.envs.builtin import DISTURBANCES
from rtd3jax.envs.registered import FAULTS
from rtd3jax.envs.registry import make
from rtd3jax.envs.rover.registration import next_slip
from rtd3jax.envs.rover.slip import Ar1SlipState

STEPS = 200


def roll(env, policy, episodes, seed=0):
    """Episodes without reset: observations [E, T+1, 2], actions, rewards [E, T], slip [E, T, 2]."""
    params = env.default_params

    def episode(key):
        key_reset, key_steps, key_action = jax.random.split(key, 3)
        first, state = env.reset_env(key_reset, params)
        actions = policy(key_action)

        def body(state, inputs):
            key, action = inputs
            # Without slip there is no slip state.
            slip = getattr(state.slip, "slip", jnp.zeros(2))
            observation, state, reward, _, _ = env.step_env(key, state, action, params)
            return state, (observation, reward, slip)

        inputs = (jax.random.split(key_steps, STEPS), actions)
        _, (observations, rewards, slip) = jax.lax.scan(body, state, inputs)
        return jnp.concatenate([first[None], observations]), actions, rewards, slip

    keys = jax.random.split(jax.random.key(seed), episodes)
    return [np.asarray(x, np.float64) for x in jax.jit(jax.vmap(episode))(keys)]


def random_actions(key):
    return jax.random.uniform(key, (STEPS, 2), jnp.float32, -1.5, 1.5)


def constant_command(key):
    return jnp.tile(jnp.array([[0.5, 0.0]]), (STEPS, 1))


def oracle(actions, slip, wheelbase=0.5, speed=0.5, yaw_rate=0.0):
    """Errors [..., 2] of the motion, by the paper's equations."""
    command_speed, command_yaw = np.moveaxis(np.clip(actions, -1, 1), -1, 0)
    left = (1 - slip[..., 0]) * (command_speed - wheelbase / 2 * command_yaw)
    right = (1 - slip[..., 1]) * (command_speed + wheelbase / 2 * command_yaw)
    return np.stack([(left + right) / 2 - speed, (right - left) / wheelbase - yaw_rate], -1)


@pytest.mark.parametrize("disturbance", ["none", "ar1-slip", "sine-slip"])
def test_motion_and_reward_follow_the_equations(disturbance):
    observations, actions, rewards, slip = roll(make("rover", disturbance), random_actions, 5)
    errors = oracle(actions, slip)
    np.testing.assert_allclose(observations[:, 1:], errors, atol=2e-6)
    np.testing.assert_allclose(rewards, -np.sum(errors**2, -1), atol=1e-5)


def test_wheelbase_and_targets_are_parameters():
    env = make("rover", "ar1-slip", wheelbase=0.8, target_speed=0.3, target_yaw_rate=-0.1)
    observations, actions, _, slip = roll(env, random_actions, 2)
    np.testing.assert_allclose(
        observations[:, 1:], oracle(actions, slip, 0.8, 0.3, -0.1), atol=2e-6
    )
    np.testing.assert_allclose(observations[:, 0], [[-0.3, 0.1]] * 2, atol=1e-7)


@pytest.mark.parametrize("disturbance", sorted(set(DISTURBANCES["rover"]) - set(FAULTS)))
def test_first_observation_is_rest(disturbance):
    observation, _ = make("rover", disturbance).reset(jax.random.key(0))
    np.testing.assert_array_equal(observation, [-0.5, 0.0])


def test_without_slip_the_command_is_the_motion():
    observations, _, rewards, _ = roll(make("rover"), constant_command, 1)
    np.testing.assert_allclose(observations[:, 1:], 0.0, atol=1e-7)
    np.testing.assert_allclose(rewards, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("disturbance", "mean"),
    [
        ("ar1-slip", 0.117),
        ("ar1-slip-high-variance", 0.190),
        ("ar1-slip-fast", 0.082),
        ("ar1-slip-slow", 0.174),
    ],
)
def test_mean_slip_is_the_papers(disturbance, mean):
    _, _, _, slip = roll(make("rover", disturbance), constant_command, 3000)
    assert slip.min() >= 0.0
    assert slip.max() <= 0.5
    assert slip.mean() == pytest.approx(mean, abs=0.004)


def test_ar1_slip_starts_uniform_and_evolves_by_its_equation():
    _, _, _, slip = roll(make("rover", "ar1-slip"), constant_command, 3000)
    start = slip[:, 0].ravel()
    assert start.mean() == pytest.approx(0.25, abs=0.01)
    assert start.std() == pytest.approx(0.5 / np.sqrt(12), abs=0.005)
    # Where the clip at 0 or 0.5 is more than four sigma away it does not show.
    before, after = slip[:, :-1].ravel(), slip[:, 1:].ravel()
    inside = (before > 0.22) & (before < 0.29)
    noise = (after - 0.95 * before)[inside]
    assert noise.mean() == pytest.approx(0.0, abs=0.002)
    assert noise.std() == pytest.approx(0.05, rel=0.02)
    # Both start high and fall, so only what is left of the mean of each step can be independent.
    deviation = slip - slip.mean(axis=0)
    wheels = np.corrcoef(deviation[..., 0].ravel(), deviation[..., 1].ravel())[0, 1]
    assert abs(wheels) < 0.03


def test_constant_command_scores_what_the_paper_says():
    _, _, rewards, _ = roll(make("rover", "ar1-slip"), constant_command, 3000)
    assert rewards.sum(1).mean() == pytest.approx(-5.25, abs=0.1)


def test_sine_slip_is_a_clipped_wave_drawn_per_wheel():
    env = make("rover", "sine-slip")
    params = env.default_params
    _, state = jax.vmap(lambda key: env.reset_env(key, params))(
        jax.random.split(jax.random.key(0), 2000)
    )
    draws = jax.tree.map(lambda x: np.asarray(x, np.float64), state.slip)
    assert set(np.unique(draws.period)) == set(range(40, 91))
    assert draws.period.mean() == pytest.approx(65, abs=1)
    assert 0.08 <= draws.amplitude.min() < 0.09
    assert 0.21 < draws.amplitude.max() <= 0.22
    assert draws.phase.min() >= 0.0
    assert draws.phase.mean() == pytest.approx(np.pi, abs=0.1)
    for field in (draws.period, draws.amplitude, draws.phase):
        assert abs(np.corrcoef(field.T)[0, 1]) < 0.1

    def waves(state):
        def body(state, _):
            speeds, state = params.slip.step(jax.random.key(0), state, jnp.ones(2))
            return state, 1 - speeds

        return jax.lax.scan(body, state, None, STEPS)[1]

    slip = np.asarray(jax.jit(jax.vmap(waves))(state.slip))
    time = np.arange(STEPS)[None, :, None]
    amplitude, period, phase = (x[:, None] for x in (draws.amplitude, draws.period, draws.phase))
    expected = np.clip(amplitude * np.sin(2 * np.pi * time / period + phase) + 0.12, 0, 0.5)
    np.testing.assert_allclose(slip, expected, atol=3e-6)


def test_time_limit_truncates_and_the_new_episode_has_a_new_slip():
    env = make("rover", "ar1-slip", max_steps_in_episode=3, sigma=0.0)
    _, state = env.reset(jax.random.key(0))
    for index in range(3):
        slip = np.asarray(state.slip.slip)
        observation, state, reward, terminated, truncated, info = env.step(
            jax.random.key(index), state, jnp.array([0.5, 0.0])
        )
        assert not terminated
        assert bool(truncated) == (index == 2)
        assert float(info["true_reward"]) == float(reward)
        final = oracle(np.array([0.5, 0.0]), slip)
        np.testing.assert_allclose(info["final_observation"], final, atol=1e-6)
    np.testing.assert_array_equal(observation, [-0.5, 0.0])
    assert int(state.time) == 0
    assert np.max(np.abs(np.asarray(state.slip.slip) - 0.95 * slip)) > 1e-3


def test_the_hidden_slip_of_joined_slips_is_that_of_the_motion():
    env = make("rover", "sine-slip+ar1-slip-fast+ar1-slip", max_steps_in_episode=20)
    played = rtd.rollout(rtd.constant_policy([0.5, 0.2]), env, seed=1)
    errors = oracle(played.actions, played.hidden)
    np.testing.assert_allclose(errors, played.true[:, 1:], atol=2e-6)


def test_the_hidden_slip_of_one_process_is_its_own():
    _, state = make("rover", "ar1-slip").reset(jax.random.key(0))
    assert next_slip(state) is state.slip.slip
    joined = state.replace(slip=(state.slip, Ar1SlipState(jnp.ones(1))))
    assert next_slip(joined) is None  # a slip of one wheel, but it is not known of which
    one_wheel = Ar1SlipState(jnp.ones(1))
    assert next_slip(state.replace(slip=(one_wheel, one_wheel))) is None
    assert next_slip(state.replace(slip=())) is None


@pytest.mark.parametrize(("plant", "slip"), [("rover", "ar1-slip"), ("rover-soil", "dry-sand")])
def test_gradients_through_a_step_are_differences(plant, slip):
    env = rtd.make(plant, slip)
    params, key = env.default_params, jax.random.key(3)
    state = env.reset(key, params)[1].replace(speed=jnp.float32(0.3), yaw_rate=jnp.float32(0.1))
    leaves, structure = jax.tree.flatten(state)
    moving = [k for k, leaf in enumerate(leaves) if leaf.dtype == jnp.float32]
    start, restore = ravel_pytree(([leaves[k] for k in moving], jnp.array([0.43, 0.11])))

    def outcome(env, point):
        floats, action = restore(point)
        parts = list(leaves)
        for k, leaf in zip(moving, floats, strict=True):
            parts[k] = leaf
        given = jax.tree.unflatten(structure, parts)
        observation, after, reward, *_ = env.step_env(key, given, action, params)
        return jnp.concatenate([observation, reward[None]]), after

    def seen(env):
        return jax.jit(lambda point: outcome(env, point)[0])

    with_gradients = env.with_transition_gradients()
    own = np.asarray(jax.jit(jax.jacobian(seen(with_gradients)))(start))
    assert np.isfinite(own).all() and np.abs(own[:, -2:]).max() > 0.3
    directions = np.random.default_rng(0).normal(size=(20, start.size)).astype(np.float32)
    directions = np.vstack([directions, np.eye(start.size, dtype=np.float32)[-2:]])
    for direction in directions / np.linalg.norm(directions, axis=1, keepdims=True):
        up, down = (seen(env)(start + sign * 2e-3 * direction) for sign in (1, -1))
        slope = (np.asarray(up, np.float64) - np.asarray(down, np.float64)) / 4e-3
        np.testing.assert_allclose(own @ direction, slope, rtol=0.02, atol=2e-3)
    # A step of training is the same with and without, and stops gradients of the observation.
    for one, other in zip(
        jax.tree.leaves(jax.jit(lambda p: outcome(env, p))(start)),
        jax.tree.leaves(jax.jit(lambda p: outcome(with_gradients, p))(start)),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    assert not np.asarray(jax.jit(jax.jacobian(seen(env)))(start))[:2].any()
