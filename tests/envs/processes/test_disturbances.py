"""Tests every disturbance of the pendulum by its effects over 1,000 episodes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtd3jax.envs.builtin import DISTURBANCES
from rtd3jax.envs.disturbed import Disturbed, DisturbedParams
from rtd3jax.envs.pendulum.environment import Pendulum
from rtd3jax.envs.processes.disturbances import DampedSine, GaussianNoise, Hidden, Pulses, Sine
from rtd3jax.envs.processes.process import Chain, Process
from rtd3jax.envs.registered import FAULTS
from rtd3jax.envs.registry import make
from rtd3jax.errors import UserError

EPISODES, STEPS = 1000, 200
OWN = [name for name in DISTURBANCES["pendulum"] if name not in FAULTS]


@dataclasses.dataclass
class Rollout:
    """E episodes of T steps with random actions; T+1 observations, the final one included."""

    seen: np.ndarray  # [E, T+1, O]
    true: np.ndarray  # [E, T+1, 3], from the true state
    reported: np.ndarray  # [E, T, 3], info["true_observation"]
    reward: np.ndarray  # [E, T]
    true_reward: np.ndarray  # [E, T], info["true_reward"]
    action: np.ndarray  # [E, T, 1]
    states: object  # true states, [E, T+1] leaves
    process: object  # states of the process at reset, [E] leaves

    @property
    def offset(self):
        """What the disturbance added, [E, T+1, 3]."""
        return self.seen.astype(np.float64) - self.true


@functools.cache
def roll(disturbance, episodes=EPISODES, **parameters):
    env = make("pendulum", disturbance, **parameters)
    params = env.default_params

    def observe(state):
        return jnp.stack([jnp.cos(state.theta), jnp.sin(state.theta), state.theta_dot])

    def episode(key):
        key_reset, key_action, key_steps = jax.random.split(key, 3)
        first, start = env.reset_env(key_reset, params)
        actions = jax.random.uniform(key_action, (STEPS, 1), jnp.float32, -2.0, 2.0)

        def body(state, inputs):
            seen, state, reward, _, info = env.step_env(inputs[0], state, inputs[1], params)
            out = (seen, state.env, reward, info["true_reward"], info["true_observation"])
            return state, out

        keys = jax.random.split(key_steps, STEPS)
        _, (seen, states, reward, true_reward, reported) = jax.lax.scan(
            body, start, (keys, actions)
        )
        states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start.env, states)
        seen = jnp.concatenate([first[None], seen])
        true = jax.vmap(observe)(states)
        return Rollout(seen, true, reported, reward, true_reward, actions, states, start.process)

    run = jax.jit(jax.vmap(lambda key: vars(episode(key))))
    fields = run(jax.random.split(jax.random.key(7), episodes))
    return Rollout(**jax.tree.map(np.asarray, fields))


def uniform_distance(values, low, high):
    """Kolmogorov-Smirnov distance to U(low, high), in units of its 0.1 % critical value."""
    values = np.sort(np.ravel(values))
    expected = np.clip((values - low) / (high - low), 0, 1)
    count = len(values)
    steps = np.arange(count + 1) / count
    distance = max(np.max(steps[1:] - expected), np.max(expected - steps[:-1]))
    return distance * np.sqrt(count) / 1.95


@pytest.mark.parametrize("disturbance", OWN)
def test_true_state_and_true_reward_are_untouched(disturbance):
    result = roll(disturbance)
    pendulum = Pendulum()

    def step(state, action):
        observation, state, reward, _, _ = pendulum.step_env(
            jax.random.key(0), state, action, pendulum.default_params
        )
        return observation, state, reward

    before = jax.tree.map(lambda x: x[:50, :-1], result.states)
    observation, after, reward = jax.jit(jax.vmap(jax.vmap(step)))(before, result.action[:50])
    np.testing.assert_allclose(after.theta, result.states.theta[:50, 1:], atol=1e-5)
    np.testing.assert_allclose(after.theta_dot, result.states.theta_dot[:50, 1:], atol=1e-5)
    np.testing.assert_allclose(reward, result.true_reward[:50], atol=1e-4)
    np.testing.assert_allclose(observation, result.reported[:50], atol=1e-5)
    np.testing.assert_allclose(result.true[:, 1:], result.reported, atol=1e-5)
    if disturbance != "noise":
        np.testing.assert_array_equal(result.reward, result.true_reward)


def test_none_shows_the_truth():
    np.testing.assert_allclose(roll("none").offset, 0.0, atol=1e-5)


def test_hidden_removes_the_angular_velocity_only():
    result = roll("hidden")
    assert result.seen.shape == (EPISODES, STEPS + 1, 2)
    np.testing.assert_allclose(result.seen, result.true[..., :2], atol=1e-5)


@pytest.mark.parametrize(
    ("disturbance", "elements"),
    [
        ("temporal-bias", (0, 1)),
        ("temporal-sine", (0, 1)),
        ("random-sine", (0, 1, 2)),
        ("combined-sine", (0, 1, 2)),
        ("damped-sine", (0, 1, 2)),
    ],
)
def test_the_same_offset_is_added_to_the_named_elements(disturbance, elements):
    offset = roll(disturbance).offset
    assert np.max(np.abs(offset[..., 0])) > 0.5
    for element in range(3):
        expected = offset[..., 0] if element in elements else np.zeros_like(offset[..., 0])
        np.testing.assert_allclose(offset[..., element], expected, atol=1e-5)


def test_temporal_bias_is_ten_whole_pulses_that_do_not_overlap():
    offset = roll("temporal-bias").offset[..., 0]
    assert np.max(np.abs(offset[:, STEPS])) < 1e-5, "the final observation is past the horizon"
    amplitudes, starts = [], []
    for episode in offset:
        active = np.flatnonzero(np.abs(episode) > 1e-3)
        assert len(active) == 30
        for triple in active.reshape(10, 3):
            assert list(triple) == list(range(triple[0], triple[0] + 3))
            assert np.ptp(episode[triple]) < 1e-5
            amplitudes.append(episode[triple].mean())
            starts.append(triple[0])
    assert min(amplitudes) >= 0.5 - 1e-5
    assert max(amplitudes) <= 1.0 + 1e-5
    assert uniform_distance(amplitudes, 0.5, 1.0) < 1
    assert min(starts) == 0
    assert max(starts) == 197
    # By symmetry in time; starts are not quite uniform, as the ends have fewer neighbours.
    assert np.mean(starts) == pytest.approx(98.5, abs=2)
    assert np.mean(np.array(starts) < 98.5) == pytest.approx(0.5, abs=0.02)


def trace(process, horizon, steps, count, size=3):
    """Offsets [count, steps, size] that a process adds to a zero signal; horizon is traced."""

    def one(key, horizon):
        key_init, key_steps = jax.random.split(key)

        def body(state, key):
            signal, state = process.step(key, state, jnp.zeros(size))
            return state, signal

        return jax.lax.scan(
            body, process.init(key_init, horizon, size), jax.random.split(key_steps, steps)
        )[1]

    keys = jax.random.split(jax.random.key(3), count)
    return np.asarray(jax.jit(jax.vmap(one, in_axes=(0, None)))(keys, jnp.int32(horizon)))


def test_every_placement_of_pulses_is_equally_likely():
    offset = trace(Pulses(count=2, length=2), horizon=6, steps=7, count=6000)[..., 0]
    patterns, counts = np.unique(offset > 0, axis=0, return_counts=True)
    # Two blocks of two in six steps: choose 2 of 4 places. Adjacent blocks look alike whatever
    # their boundary, and no two of the six placements share a pattern.
    assert len(patterns) == 6
    assert not np.any(patterns[:, 6])
    np.testing.assert_allclose(counts / 6000, 1 / 6, atol=0.02)


def test_pulses_that_do_not_fit_fill_the_episode():
    offset = trace(Pulses(count=10, length=3), horizon=8, steps=8, count=4)
    assert np.all(offset[..., :2] > 0.4)


def first_active(offset):
    """Index [E] of the first step with an offset, [E, T+1], and whether there is one."""
    active = np.abs(offset) > 1e-4
    return np.argmax(active, axis=1), active.any(axis=1)


def test_temporal_sine_is_one_whole_period_of_70_steps():
    offset = roll("temporal-sine").offset[..., 0]
    first, found = first_active(offset)
    assert found.all()
    start = first - 1  # the wave begins at zero
    time = np.arange(STEPS + 1)[None] - start[:, None]
    expected = np.where((time >= 0) & (time < 70), np.sin(2 * np.pi * time / 70), 0)
    np.testing.assert_allclose(offset, expected, atol=1e-4)
    assert start.min() == 0
    assert start.max() == 130
    assert uniform_distance(start + 0.5, 0, 131) < 1.2


def test_random_sine_draws_amplitude_period_and_start():
    offset = roll("random-sine").offset[..., 0]
    first, found = first_active(offset)
    assert found.all()
    amplitudes, periods, starts = [], [], first - 1
    for episode, start in zip(offset, starts, strict=True):
        length = np.max(np.flatnonzero(np.abs(episode) > 1e-4)) - start + 1
        wave = episode[start : start + length]
        inner, sides = wave[1:-1], wave[2:] + wave[:-2]
        omega = np.arccos(np.sum(inner * sides) / (2 * np.sum(inner**2)))
        shape = np.sin(omega * np.arange(length))
        amplitude = np.sum(shape * wave) / np.sum(shape**2)
        np.testing.assert_allclose(wave, amplitude * shape, atol=5e-3)
        amplitudes.append(amplitude)
        periods.append(2 * np.pi / omega)
        assert length == pytest.approx(periods[-1], abs=1.1), "one period, no more"
        assert start + periods[-1] <= STEPS + 0.2
    assert uniform_distance(amplitudes, 0.5, 2.0) < 1
    assert uniform_distance(periods, 10, 100) < 1
    assert starts.min() == 0
    # Given T the start is uniform on 0..200-T.
    assert uniform_distance((starts + 0.5) / (np.floor(STEPS - np.array(periods)) + 1), 0, 1) < 1.2


def test_combined_sine_is_the_sum_of_two_independent_waves():
    result = roll("combined-sine")
    draws = result.process
    assert draws.amplitude.shape == (EPISODES, 2)
    time = np.arange(STEPS + 1)[None, :, None] - draws.start[:, None]
    period, amplitude = draws.period[:, None], draws.amplitude[:, None]
    waves = np.where(
        (time >= 0) & (time < period), amplitude * np.sin(2 * np.pi * time / period), 0
    )
    np.testing.assert_allclose(result.offset[..., 0], waves.sum(-1), atol=1e-4)
    for values, low, high in ((draws.amplitude, 0.5, 2.0), (draws.period, 10, 100)):
        assert uniform_distance(values, low, high) < 1
        assert abs(np.corrcoef(values.T)[0, 1]) < 0.1


def test_damped_sine_runs_to_the_end():
    offset = roll("damped-sine").offset[..., 0]
    first, found = first_active(offset)
    assert found.all()
    starts = first - 1
    assert starts.min() <= 2
    assert starts.max() == 199
    assert uniform_distance(starts + 0.5, 0, 200) < 1.2
    grid = np.linspace(9.5, 101, 4000)
    ratio = 2 * np.exp(-1 / grid) * np.cos(2 * np.pi / grid)  # of the second step to the first
    amplitudes, periods = [], []
    for episode, start in zip(offset, starts, strict=True):
        if start > 150:
            continue
        period = np.interp(episode[start + 2] / episode[start + 1], ratio, grid)
        cycles = np.arange(STEPS + 1 - start) / period
        shape = np.exp(-cycles) * np.sin(2 * np.pi * cycles)
        amplitude = np.sum(shape * episode[start:]) / np.sum(shape**2)
        np.testing.assert_allclose(episode[start:], amplitude * shape, atol=0.02)
        amplitudes.append(amplitude)
        periods.append(period)
    assert uniform_distance(amplitudes, 0.5, 2.0) < 1
    assert uniform_distance(periods, 10, 100) < 1


@pytest.mark.parametrize("sigma", [0.5, 1.0])
def test_noise_is_white_and_gaussian(sigma):
    noise = roll("noise", sigma=sigma).offset
    assert noise.mean() == pytest.approx(0, abs=0.01)
    for element in range(3):
        assert noise[..., element].std() == pytest.approx(sigma, rel=0.01)
    assert noise[:, 0].std() == pytest.approx(sigma, rel=0.05), "the first observation too"
    assert noise[:, -1].std() == pytest.approx(sigma, rel=0.05), "the final observation too"
    assert (noise**4).mean() / sigma**4 == pytest.approx(3, abs=0.1)
    assert np.corrcoef(noise[:, 1:, 0].ravel(), noise[:, :-1, 0].ravel())[0, 1] == pytest.approx(
        0, abs=0.01
    )
    between = np.corrcoef(noise.reshape(-1, 3).T) - np.eye(3)
    assert np.max(np.abs(between)) < 0.01


def test_noise_rewards_what_was_seen_before_acting():
    result = roll("noise", sigma=0.5)
    seen = result.seen[:, :-1].astype(np.float64)
    theta = np.arctan2(seen[..., 1], seen[..., 0])
    torque = result.action[..., 0]
    expected = -(theta**2 + 0.1 * seen[..., 2] ** 2 + 0.001 * torque**2)
    np.testing.assert_allclose(result.reward, expected, atol=1e-4)
    assert np.mean(np.abs(result.reward - result.true_reward)) > 0.1


def test_noise_can_reward_the_true_state():
    result = roll("noise", episodes=20, reward_from="state")
    np.testing.assert_array_equal(result.reward, result.true_reward)


class Stamp(Process):
    """Adds a number drawn per episode, and 1000 per observation of the episode so far."""

    def init(self, key, horizon, size):
        return jax.random.uniform(key, (), jnp.float32, 1.0, 900.0), jnp.zeros((), jnp.int32)

    def step(self, key, state, signal):
        tag, count = state
        return signal + tag + 1000.0 * count.astype(jnp.float32), (tag, count + 1)


def test_an_episodes_last_observation_is_its_own_and_the_next_ones_first_is_new():
    base = Pendulum()
    params = DisturbedParams(base.default_params.replace(max_steps_in_episode=4), Stamp())
    env = Disturbed(base, default_params=params)
    observation, state = env.reset(jax.random.key(0))
    tag = float(state.process[0])
    tags = [tag]

    def truth(state):
        return np.cos(float(state.env.theta))

    assert float(observation[0]) - truth(state) == pytest.approx(tag, abs=1e-2)
    for index in range(1, 13):
        observation, state, _, terminated, truncated, info = env.step(
            jax.random.key(index), state, jnp.zeros(1)
        )
        place = (index - 1) % 4 + 1
        final = float(info["final_observation"][0]) - float(info["true_observation"][0])
        assert final == pytest.approx(tag + 1000 * place, abs=1e-2)
        assert not terminated
        assert bool(truncated) == (place == 4)
        if truncated:
            tag = float(state.process[0])
            tags.append(tag)
            assert float(observation[0]) - truth(state) == pytest.approx(tag, abs=1e-2)
            assert int(state.time) == 0
        else:
            np.testing.assert_array_equal(observation, info["final_observation"])
        np.testing.assert_array_equal(observation, state.observation)
    assert len(set(tags)) == 4


def test_a_chain_applies_its_members_in_order_with_their_own_streams():
    noise = trace(Chain(processes=(GaussianNoise(), GaussianNoise())), 200, 200, 50)
    assert noise.std() == pytest.approx(0.5 * np.sqrt(2), rel=0.02), "2 sigma were one stream twice"
    assert trace(Chain(processes=(GaussianNoise(), Hidden())), 5, 5, 2).shape == (2, 5, 2)
    assert Chain(processes=(Hidden(), Hidden(element=0))).output_size(3) == 1


def test_parameters_can_be_mapped_over():
    base = Pendulum()
    env = Disturbed(base)

    def first(sigma, key):
        params = DisturbedParams(base.default_params, GaussianNoise(sigma=sigma))
        observation, state = env.reset(key, params)
        return observation - env.base.get_obs(state.env)

    sigmas = jnp.array([0.0, 1.0, 3.0])
    added = jax.vmap(first, in_axes=(0, None))(sigmas, jax.random.key(0))
    np.testing.assert_allclose(added[0], 0, atol=1e-6)
    np.testing.assert_allclose(added[2], 3 * added[1], rtol=1e-4)


@pytest.mark.parametrize(
    ("process", "name"),
    [
        (GaussianNoise(sigma=-1.0), "sigma"),
        (GaussianNoise(sigma=float("nan")), "sigma"),
        (Pulses(amplitude_min=2.0), "amplitude_min"),
        (Pulses(length=0), "length"),
        (Pulses(elements=(0, 0)), "elements"),
        (Sine(period_min=200.0), "period_min"),
        (
            Sine(amplitude_min=np.zeros(2), amplitude_max=np.ones(3)),
            r"amplitude_.* of shape \(2,\)",
        ),
        (Sine(period_min=0.0), "period_min"),
        (Sine(waves=0), "waves"),
        (DampedSine(amplitude_max=float("inf")), "amplitude_max"),
        (Hidden(element=-1), "element"),
        (Chain(processes=(GaussianNoise(sigma=-1.0),)), "sigma"),
        (Pulses(count=2.5), "count=2.5 must be a whole number, written without"),
        (Pulses(count=True), "count"),
        (Pulses(length=3.0), "length=3.0 must be a whole number, written without"),
        (Sine(waves=2.0), "waves=2.0 must be a whole number, written without"),
        (Sine(elements=(0.0, 1)), "elements=.* must be a tuple of indices"),
        (Sine(elements=1), "elements=1 must be a tuple of indices"),
        (Hidden(element=2.0), "element=2.0 must be a whole number, written without"),
    ],
)
def test_bad_parameters_are_named(process, name):
    with pytest.raises(UserError, match=name) as caught:
        process.validate()
    assert "\n" not in str(caught.value)


def test_an_element_outside_the_observation_is_refused():
    with pytest.raises(UserError, match="element 3"):
        make("pendulum", "hidden", element=3)
    with pytest.raises(UserError, match="element 5"):
        make("pendulum", "random-sine", elements=(0, 5))


def test_reward_from_observation_needs_the_full_observation():
    with pytest.raises(UserError, match="full observation"):
        make("pendulum", "hidden", reward_from="observation")


def test_reward_from_observation_needs_an_environment_that_can_tell():
    with pytest.raises(UserError, match="observed_reward"):
        Disturbed(make("rover"), reward_from="observation")
