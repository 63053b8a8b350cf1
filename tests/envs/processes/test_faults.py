"""Compares faults with slow numpy oracles, on every channel, and tests their reset."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces

from rtd3jax.envs.disturbed import Disturbed, disturb
from rtd3jax.envs.interface import describe
from rtd3jax.envs.processes.disturbances import GaussianNoise, Hidden
from rtd3jax.envs.processes.faults import Delay, Dropout, GainDrift, OrnsteinUhlenbeck, Quantisation
from rtd3jax.envs.processes.process import Chain, Nothing, Process, Sum
from rtd3jax.envs.registered import FAULTS
from rtd3jax.envs.registry import make
from rtd3jax.errors import UserError

STEPS = 300


def drive(process, signals, seed=0, horizon=STEPS):
    """What leaves [T, N] for the signals [T, N] that enter, and the states, the first included."""
    key_init, key_steps = jax.random.split(jax.random.key(seed))
    start = process.init(key_init, horizon, signals.shape[1])

    def body(state, inputs):
        out, state = process.step(inputs[0], state, inputs[1])
        return state, (out, state)

    keys = jax.random.split(key_steps, len(signals))
    _, (out, states) = jax.lax.scan(body, start, (keys, jnp.asarray(signals, jnp.float32)))
    states = jax.tree.map(lambda a, b: np.concatenate([a[None], b]), start, states)
    return np.asarray(out, np.float64), states


@pytest.fixture(scope="module")
def signals():
    """Never zero, and no two steps alike."""
    return np.random.default_rng(0).uniform(0.5, 3.0, (STEPS, 3)).astype(np.float32)


@pytest.mark.parametrize("hold", [True, False])
def test_dropout_loses_whole_signals_and_holds_the_last(signals, hold):
    out, _ = drive(Dropout(p=0.4, hold=hold), signals)
    arrived = np.all(out == signals, axis=1)
    assert np.mean(~arrived) == pytest.approx(0.4, abs=0.1)
    last = np.zeros(3)
    for t in range(STEPS):
        if arrived[t]:
            last = signals[t]
        np.testing.assert_array_equal(out[t], last if arrived[t] or hold else np.zeros(3))


def test_dropout_at_its_limits(signals):
    np.testing.assert_array_equal(drive(Dropout(p=0.0), signals)[0], signals)
    assert not np.any(drive(Dropout(p=1.0), signals)[0])


@pytest.mark.parametrize("steps", [0, 1, 3])
def test_delay_shows_what_was_some_steps_ago(signals, steps):
    out, _ = drive(Delay(steps=steps), signals)
    for t in range(STEPS):
        np.testing.assert_array_equal(out[t], signals[t - steps] if t >= steps else np.zeros(3))


def test_quantisation_rounds_to_the_nearest_multiple(signals):
    for resolution in (0.25, np.array([0.1, 0.5, 2.0])):
        out, _ = drive(Quantisation(resolution=jnp.asarray(resolution)), signals)
        steps = np.broadcast_to(resolution, (3,))
        np.testing.assert_allclose(out / steps, np.round(out / steps), atol=1e-5)
        assert np.all(np.abs(out - signals) <= steps / 2 + 1e-6)


def test_gain_drifts_from_one_within_its_limits(signals):
    process = GainDrift(sigma=0.1, gain_min=0.8, gain_max=1.1)
    out, gains = drive(process, signals)
    np.testing.assert_array_equal(gains[0], 1.0)
    np.testing.assert_allclose(out, gains[:-1] * signals, rtol=1e-6)
    assert gains.min() == pytest.approx(0.8) and gains.max() == pytest.approx(1.1)
    wide = GainDrift(sigma=0.1, gain_min=-100.0, gain_max=100.0)
    steps = np.diff(drive(wide, np.ones((5000, 3)))[1], axis=0)
    assert steps.std() == pytest.approx(0.1, rel=0.03)
    assert np.max(np.abs(np.corrcoef(steps.T) - np.eye(3))) < 0.06, "a gain for each element"


def test_ornstein_uhlenbeck_is_stationary_with_its_correlation():
    process = OrnsteinUhlenbeck(sigma=0.7, time_constant=5.0, mean=2.0)
    run = jax.jit(jax.vmap(lambda seed: _bias(process, seed)))
    bias = np.asarray(run(jnp.arange(4000)), np.float64)  # [E, T, 3]
    for t in (0, 1, 19):
        assert bias[:, t].mean() == pytest.approx(2.0, abs=0.03)
        assert bias[:, t].std() == pytest.approx(0.7, rel=0.03)
    for lag in (1, 5):
        pairs = (bias[:, lag:] - 2.0) * (bias[:, :-lag] - 2.0)
        assert pairs.mean() / 0.49 == pytest.approx(np.exp(-lag / 5.0), abs=0.03)
    assert np.max(np.abs(np.corrcoef(bias[:, 0].T) - np.eye(3))) < 0.06


def _bias(process, seed):
    key_init, key_steps = jax.random.split(jax.random.key(seed))

    def body(state, key):
        out, state = process.step(key, state, jnp.zeros(3))
        return state, out

    return jax.lax.scan(body, process.init(key_init, 20, 3), jax.random.split(key_steps, 20))[1]


def test_ornstein_uhlenbeck_disturbs_the_named_elements_only(signals):
    out, bias = drive(OrnsteinUhlenbeck(elements=(1,)), signals)
    np.testing.assert_array_equal(out[:, [0, 2]], signals[:, [0, 2]])
    np.testing.assert_allclose(out[:, 1], signals[:, 1] + bias[:-1, 1], rtol=1e-5)


def test_a_sum_adds_what_each_would_add_alone_and_a_chain_does_not(signals):
    scale, shift = Scale(factor=3.0), Shift(offset=10.0)
    both = (shift, scale)
    np.testing.assert_allclose(drive(Sum(both), signals)[0], 3.0 * signals + 10.0, rtol=1e-5)
    np.testing.assert_allclose(drive(Chain(both), signals)[0], 3.0 * (signals + 10.0), rtol=1e-5)
    nested = Chain((Sum(both), Delay(1)))
    np.testing.assert_allclose(drive(nested, signals)[0][1:], 3.0 * signals[:-1] + 10.0, rtol=1e-5)


def test_members_of_a_sum_have_streams_of_their_own():
    noise, _ = drive(Sum((GaussianNoise(1.0), GaussianNoise(1.0))), np.zeros((20_000, 1)))
    assert noise.std() == pytest.approx(np.sqrt(2.0), rel=0.03), "2 were one stream twice"


def test_a_chain_tells_later_members_the_size_that_reaches_them(signals):
    out, _ = drive(Chain((Hidden(element=0), Delay(2))), signals)
    np.testing.assert_array_equal(out[2:], signals[:-2, 1:])


class Scale(Process):
    factor: float = 1.0

    def init(self, key, horizon, size):
        return ()

    def step(self, key, state, signal):
        return self.factor * signal, state


class Shift(Process):
    offset: float = 1.0

    def init(self, key, horizon, size):
        return ()

    def step(self, key, state, signal):
        return signal + self.offset, state


class Stamp(Process):
    """Adds a number drawn per episode, and 1,000 per step of the episode so far."""

    def init(self, key, horizon, size):
        return jax.random.uniform(key, (), jnp.float32, 1.0, 900.0), jnp.zeros((), jnp.int32)

    def step(self, key, state, signal):
        tag, count = state
        return signal + tag + 1000.0 * count.astype(jnp.float32), (tag, count + 1)


@struct.dataclass
class State:
    time: jax.Array
    applied: jax.Array


class Echo(environment.Environment):
    """Shows the action it received; the reward is its sum. Three steps; no observation space."""

    @property
    def default_params(self):
        return environment.EnvParams(max_steps_in_episode=3)

    def reset_env(self, key, params):
        return jnp.zeros(2), State(jnp.int32(0), jnp.zeros(2))

    def step_env(self, key, state, action, params):
        applied = jnp.asarray(action, jnp.float32).reshape(-1)
        state = State(state.time + jnp.int32(1), applied)
        return applied, state, jnp.sum(applied), jnp.array(False), {}

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (2,))


def play(env, steps, action=(0.25, -0.5)):
    """Observations (final ones in place of those after a reset), rewards, infos, states after."""
    _, state = env.reset(jax.random.key(0))
    seen, rewards, infos, states = [], [], [], [state]
    for t in range(steps):
        _, state, reward, _, _, info = env.step(jax.random.key(t), state, jnp.array(action))
        seen.append(np.asarray(info["final_observation"]))
        rewards.append(float(reward))
        infos.append(info)
        states.append(state)
    return np.array(seen), np.array(rewards), infos, states


def test_an_actions_process_acts_before_the_dynamics_and_begins_anew():
    seen, rewards, infos, _ = play(disturb(Echo(), Delay(2), "action"), 7)
    command, none = np.array([0.25, -0.5]), np.zeros(2)
    expected = np.array([none, none, command, none, none, command, none])
    np.testing.assert_array_equal(seen, expected)
    np.testing.assert_allclose(rewards, expected.sum(1))
    np.testing.assert_array_equal(infos[2]["true_observation"], command)


def test_a_rewards_process_changes_the_reward_alone():
    seen, rewards, infos, states = play(disturb(Echo(), Stamp(), "reward"), 7)
    np.testing.assert_array_equal(seen, np.tile([0.25, -0.5], (7, 1)))
    assert all(float(info["true_reward"]) == -0.25 for info in infos)
    tags = [float(states[start].reward[0]) for start in (0, 3, 6)]
    assert len(set(tags)) == 3
    expected = [-0.25 + tags[t // 3] + 1000.0 * (t % 3) for t in range(7)]
    np.testing.assert_allclose(rewards, expected, rtol=1e-5)


def test_the_final_observation_is_of_the_old_episodes_disturbance():
    seen, _, _, states = play(disturb(Echo(), Stamp()), 6)
    for t in range(6):
        tag = float(states[3 * (t // 3)].process[0])
        # The first observation was number 0 of the episode.
        expected = np.array([0.25, -0.5]) + tag + 1000.0 * (t % 3 + 1)
        np.testing.assert_allclose(seen[t], expected, rtol=1e-5)
    assert float(states[0].process[0]) != float(states[3].process[0])


def test_channels_and_processes_compose_in_the_order_of_adding():
    env = disturb(disturb(Echo(), Shift(1.0)), Delay(1), "action")
    env = disturb(env, Scale(2.0))
    assert isinstance(env, Disturbed) and isinstance(env.base, Echo)
    seen, _, infos, _ = play(env, 3)
    np.testing.assert_array_equal(seen[2], 2.0 * (np.array([0.25, -0.5]) + 1.0))
    np.testing.assert_array_equal(seen[0], [2.0, 2.0])
    np.testing.assert_array_equal(infos[2]["true_observation"], [0.25, -0.5])


class Draw(Process):
    """Adds one number to all elements, the first that its key gives."""

    scale: float = 1.0

    def init(self, key, horizon, size):
        return ()

    def step(self, key, state, signal):
        return signal + self.scale * jax.random.uniform(key, ()), state


def test_the_channels_and_their_members_have_streams_of_their_own():
    added = []
    for observed in (Draw(), Chain((Draw(), Draw(0.0))), Chain((Draw(0.0), Draw()))):
        env = disturb(disturb(Echo(), observed), Draw(), "action")
        seen, rewards, infos, _ = play(disturb(env, Draw(), "reward"), 1)
        true = np.asarray(infos[0]["true_observation"])
        added += [seen[0, 0] - true[0], true[0] - 0.25, rewards[0] - true.sum()]
    # Of nine, action and reward are the same in all three cases: 5 differ.
    assert len(np.unique(np.round(added, 4))) == 5


@pytest.mark.parametrize("name", FAULTS)
@pytest.mark.parametrize("env_id", ["pendulum", "rover", "MountainCarContinuous-v0"])
def test_faults_are_known_by_name_on_any_environment(env_id, name):
    env = make(env_id, name)
    assert isinstance(env, Disturbed)
    params = env.default_params
    assert isinstance(params.action, Nothing) != name.startswith(("action", "gain"))
    assert describe(env, params).observation_size == env.observation_space().shape[0]


def test_names_are_joined_and_parameters_find_their_owner():
    env = make("rover", "ar1-slip+dropout+delay+gain-drift", rho=0.5, p=0.3, steps=4, wheelbase=0.8)
    params = env.default_params
    assert (params.env.slip.rho, params.env.wheelbase) == (0.5, 0.8)
    assert params.observation == Chain((Dropout(p=0.3), Delay(4)))
    assert params.action == GainDrift()
    assert make("pendulum", "noise+delay").reward_from == "observation"
    assert make("pendulum", "none+none").default_params.observation == Nothing()


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: make("pendulum", "dropuot"), "did you mean 'dropout'"),
        (lambda: make("pendulum", "dropout", p=1.5), "p=1.5"),
        (lambda: make("pendulum", "delay", steps=0.5), "steps"),
        (
            lambda: make("pendulum", "delay+action-delay", steps=1),
            "'steps' is a parameter of delay and",
        ),
        (lambda: make("rover", "dropout+noise"), "unknown disturbance 'noise'"),
        (lambda: make("rover", "ornstein-uhlenbeck", elements=(2,)), "element 2"),
        (lambda: disturb(Echo(), Delay(steps=1.5)), "whole number"),
        (lambda: disturb(Echo(), Delay(steps=2.0)), "steps=2.0 must be a whole number"),
        (lambda: disturb(Echo(), Chain(Delay())), r"Chain: the processes must be a tuple"),
        (lambda: disturb(Echo(), Chain((Delay,))), r"Delay is a class; .* such as Delay\(\)"),
        (lambda: disturb(Echo(), Chain((Delay(), 3))), "Chain: 3 is not a process"),
        (lambda: disturb(Echo(), Sum(())), "Sum has no members"),
        (
            lambda: disturb(Echo(), GaussianNoise(sigma=[0.1, 0.2, 0.3])),
            r"GaussianNoise: sigma of shape \(3,\) does not fit a signal of 2 elements",
        ),
        (lambda: disturb(Echo(), Quantisation(np.ones(3))), "resolution of shape"),
        (lambda: disturb(Echo(), GainDrift(gain_min=[0.1] * 3)), "gain_min of shape"),
        (lambda: disturb(Echo(), OrnsteinUhlenbeck(mean=np.zeros(4))), "mean of shape"),
        (lambda: disturb(Echo(), Quantisation(resolution=0.0)), "resolution"),
        (lambda: disturb(Echo(), GainDrift(gain_min=2.0)), "gain_min"),
        (lambda: disturb(Echo(), OrnsteinUhlenbeck(time_constant=0.0)), "time_constant"),
        (lambda: disturb(Echo(), Sum((Hidden(),))), "element 2"),
        (lambda: disturb(Echo(), Sum((Hidden(element=0),))), "use a Chain"),
        (lambda: disturb(Echo(), Hidden(element=0), "action"), "not possible for the action"),
        (lambda: disturb(Echo(), Delay(), "actions"), "did you mean 'action'"),
        (lambda: disturb(Echo(), 3.0), "not a process"),
        (lambda: disturb(object(), Delay()), "object has no method reset"),
        (lambda: disturb(make("CartPole-v1"), Delay()), "discrete"),
    ],
)
def test_mistakes_are_named(call, match):
    with pytest.raises(UserError, match=match) as caught:
        call()
    assert "\n" not in str(caught.value)
