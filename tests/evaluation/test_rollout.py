"""Tests that the steps of episodes agree with the evaluation, and their names."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import environment, spaces
from gymnax.environments.classic_control.pendulum import Pendulum

import rtd3jax as rtd


@pytest.fixture(scope="module")
def rover():
    env = rtd.make("rover", "ar1-slip")
    return env, rtd.rollout(rtd.bayes_policy(env), env, seed=4, episodes=2)


@pytest.fixture(scope="module")
def pendulum():
    env = rtd.make("pendulum", "noise", sigma=0.3, max_steps_in_episode=30)
    return env, rtd.rollout(rtd.random_policy(env), env, seed=4, episodes=2)


def test_they_are_the_episodes_of_the_evaluation(rover, pendulum):
    for (env, played), policy in ((rover, rtd.bayes_policy), (pendulum, rtd.random_policy)):
        for true_reward, rewards in ((False, played.rewards), (True, played.true_rewards)):
            expected = rtd.evaluate(policy(env), env, 2, 4, true_reward=true_reward)
            np.testing.assert_allclose(rewards.sum(axis=1), expected, rtol=1e-5)
    assert np.ptp(pendulum[1].true_rewards - pendulum[1].rewards) > 0.1


def test_rewards_follow_from_what_is_beside_them(rover, pendulum):
    """An oracle: the rover's motion from action and slip, the pendulum's reward from its angle."""
    _, played = rover
    command, slip = played.actions, played.hidden
    turn = 0.25 * command[..., 1]
    left = (1 - slip[..., 0]) * (command[..., 0] - turn)
    right = (1 - slip[..., 1]) * (command[..., 0] + turn)
    errors = np.stack([(left + right) / 2 - 0.5, (right - left) / 0.5], axis=-1)
    np.testing.assert_allclose(played.true[:, 1:], errors, atol=2e-6)
    np.testing.assert_array_equal(played.seen, played.true)
    _, played = pendulum
    for observation, rewards in ((played.seen, played.rewards), (played.true, played.true_rewards)):
        cosine, sine, velocity = np.moveaxis(observation[:, :-1], -1, 0)
        cost = np.arctan2(sine, cosine) ** 2 + 0.1 * velocity**2
        cost += 0.001 * played.actions[..., 0] ** 2
        np.testing.assert_allclose(rewards, -cost, rtol=1e-4, atol=1e-4)
    # The first observation too: the true one lies on the circle, what was seen does not.
    np.testing.assert_allclose(np.sum(played.true[..., :2] ** 2, -1), 1, atol=1e-5)
    assert np.all(np.abs(np.sum(played.seen[:, 0, :2] ** 2, -1) - 1) > 1e-3)


def test_the_frame_is_tidy(rover):
    _, played = rover
    frame = played.to_frame()
    assert list(frame) == [
        *("episode", "step", "seen speed error", "seen yaw-rate error"),
        *("true speed error", "true yaw-rate error", "action speed", "action yaw rate"),
        *("reward", "true reward", "terminated", "truncated", "slip left", "slip right"),
    ]
    assert len(frame) == 2 * 201 and frame["truncated"].dtype == bool
    second = frame[frame["episode"] == 1]
    np.testing.assert_array_equal(second["slip right"][:-1], played.hidden[1, :, 1])
    np.testing.assert_allclose(frame.groupby("episode")["reward"].sum(), played.returns, rtol=1e-5)
    assert second["step"].tolist() == list(range(201))
    assert second["truncated"].to_numpy().nonzero()[0].tolist() == [199]
    assert second.iloc[-1][["action speed", "reward", "slip left"]].isna().all()


def test_an_element_that_is_not_seen_has_no_seen_column():
    env = rtd.make("pendulum", "hidden", element=0, max_steps_in_episode=5)
    frame = rtd.rollout(rtd.constant_policy([1.0]), env).to_frame()
    seen = [name for name in frame if name.startswith("seen")]
    assert seen == ["seen sin θ", "seen angular velocity"] and "true cos θ" in frame
    np.testing.assert_array_equal(frame["seen sin θ"], frame["true sin θ"])
    np.testing.assert_allclose(frame["time"], 0.05 * np.arange(6))


def test_episodes_end_at_their_own_length():
    """An episode that terminates is followed by nothing, beside longer ones."""
    env = rtd.make("MountainCarContinuous-v0", max_steps_in_episode=150)
    push = rtd.rollout(Rocking(), env, seed=0, episodes=4)
    assert push.terminated.any() and push.truncated.any()
    for episode, length in enumerate(push.lengths):
        assert np.isfinite(push.seen[episode, : length + 1]).all()
        assert np.isnan(push.seen[episode, length + 1 :]).all()
        assert np.isnan(push.rewards[episode, length:]).all()
        ended = push.terminated[episode] | push.truncated[episode]
        assert ended.nonzero()[0].tolist() == [length - 1]
    assert len(push.to_frame()) == push.lengths.sum() + 4
    expected = rtd.evaluate(Rocking(), env, 4, 0)
    np.testing.assert_allclose(push.returns, expected, rtol=1e-5)
    assert rtd.rollout(Rocking(), env, steps=7).lengths.tolist() == [7]


@jax.tree_util.register_static
class Rocking:
    """Pushes the car the way it goes."""

    def init(self, key=None):
        return ()

    def step(self, state, observation):
        return jax.numpy.sign(observation[1:]), state

    def __hash__(self):
        return 0

    def __eq__(self, other):
        return isinstance(other, Rocking)


def test_the_picture_shows_each_signal(rover, pendulum):
    figure = rtd.plot_episode(rover[1], 1)
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels[:2] == ["speed error", "yaw-rate error"]
    assert labels[2:] == ["speed", "yaw rate", "hidden", "reward"]
    assert "episode 1 of seed 4: return" in figure.get_suptitle()
    drawn = figure.axes[4].get_lines()[1]
    np.testing.assert_array_equal(drawn.get_ydata()[:-1], rover[1].hidden[1, :, 1])
    figure = rtd.plot_episode(pendulum[1])
    seen, true = figure.axes[0].get_lines()
    np.testing.assert_array_equal(seen.get_ydata(), pendulum[1].seen[0, :, 0])
    np.testing.assert_array_equal(true.get_ydata(), pendulum[1].true[0, :, 0])
    assert figure.axes[-1].get_xlabel() == "time in s"
    assert true.get_xdata()[-1] == pytest.approx(1.5)


def test_mistakes_are_named(rover):
    env, played = rover
    for episode in (2, -1, True, 0.5):
        with pytest.raises(rtd.UserError, match="episode must be an integer from 0 to 1"):
            rtd.plot_episode(played, episode)
    with pytest.raises(rtd.UserError, match="needs the result of rtd.rollout, not DataFrame"):
        rtd.plot_episode(played.to_frame())
    with pytest.raises(rtd.UserError, match="episodes must be an integer of at least 1, not 0"):
        rtd.rollout(rtd.bayes_policy(env), env, episodes=0)
    with pytest.raises(rtd.UserError, match=r"action has shape \(1,\), the environment's \(2,\)"):
        rtd.rollout(rtd.constant_policy([0.0]), env)


class FirstRemoved(rtd.Process):
    """Removes the first element, of which nobody is told."""

    def init(self, key, horizon, size):
        return ()

    def step(self, key, state, signal):
        return signal[1:], state


def test_elements_of_unknown_origin_have_names_of_their_own():
    env = rtd.disturb(rtd.make("Pendulum-v1"), FirstRemoved())
    played = rtd.rollout(rtd.constant_policy([0.0]), env, steps=3)
    assert played.seen_names == ("s[0]", "s[1]")
    assert played.observation_names == ("o[0]", "o[1]", "o[2]")
    np.testing.assert_array_equal(played.seen[0], played.true[0, :, 1:])


def test_a_reward_that_is_not_a_number_is_not_hidden(pendulum):
    _, played = pendulum
    rewards = played.rewards.copy()
    rewards[0, 3] = np.nan
    returns = dataclasses.replace(played, rewards=rewards).returns
    assert np.isnan(returns[0]) and returns[1] == played.returns[1]


class Grid(environment.Environment):
    """The reward is the sum of the first row of an action [2, 3]."""

    @property
    def default_params(self):
        return environment.EnvParams(max_steps_in_episode=2)

    def reset_env(self, key, params):
        return jnp.zeros((1,), jnp.float32), environment.EnvState(jnp.int32(0))

    def step_env(self, key, state, action, params):
        after = environment.EnvState(state.time + jnp.int32(1))
        return jnp.zeros((1,), jnp.float32), after, jnp.sum(action[0]), jnp.array(False), {}

    def action_space(self, params):
        return spaces.Box(0.0, 5.0, (2, 3))


def test_a_flat_constant_action_gets_the_environments_shape():
    flat, env = rtd.constant_policy(np.arange(6.0)), Grid()
    shaped = rtd.constant_policy(np.arange(6.0).reshape(2, 3))
    for policy in (flat, shaped):
        assert float(rtd.evaluate(policy, env, 1)[0]) == 2 * (0 + 1 + 2)
        assert float(rtd.rollout(policy, env).returns[0]) == 2 * (0 + 1 + 2)
        assert rtd.robustness(policy, env, ["delay=0"], 1)["return"].item() == 2 * (0 + 1 + 2)


def _sum_of_counts(state, observation):
    return jnp.arange(6.0), state


class Scalar(Grid):
    """Its action is a number."""

    def step_env(self, key, state, action, params):
        assert action.shape == ()
        return super().step_env(key, state, jnp.broadcast_to(action, (2, 3)), params)

    def action_space(self, params):
        return spaces.Box(0.0, 5.0, ())


@pytest.mark.parametrize(
    ("env", "function", "reward"),
    [
        (Grid(), _sum_of_counts, 0 + 1 + 2),
        (Scalar(), lambda state, observation: (2.0, state), 3 * 2.0),
        (Scalar(), lambda state, observation: (jnp.full(1, 2.0), state), 3 * 2.0),
    ],
)
def test_a_functions_action_gets_the_environments_shape(env, function, reward):
    policy = rtd.function_policy(function)
    assert float(rtd.evaluate(policy, env, 1)[0]) == 2 * reward
    assert float(rtd.rollout(policy, env).returns[0]) == 2 * reward
    with pytest.raises(rtd.UserError, match=r"action has shape \(4,\)"):
        rtd.evaluate(rtd.function_policy(lambda state, seen: (jnp.zeros(4), state)), env, 1)


class Telling(Pendulum):
    """Reads its angle with an offset, and tells the undisturbed observation."""

    def reset_env(self, key, params):
        observation, state = super().reset_env(key, params)
        return observation + 1.0, state

    def step_env(self, key, state, action, params):
        observation, state, reward, terminated, info = super().step_env(key, state, action, params)
        return (
            observation + 1.0,
            state,
            reward,
            terminated,
            {**info, "true_observation": observation},
        )


class TellingAtOnce(Telling):
    def true_observation(self, state, params):
        return self.get_obs(state)


def test_the_first_true_observation_is_known_from_the_method():
    policy = rtd.constant_policy([0.0])
    played = rtd.rollout(policy, TellingAtOnce(), steps=3)
    np.testing.assert_allclose(played.true, played.seen - 1.0, atol=1e-6)
    played = rtd.rollout(policy, Telling(), steps=3)
    assert np.isnan(played.true[:, 0]).all()
    np.testing.assert_allclose(played.true[:, 1:], played.seen[:, 1:] - 1.0, atol=1e-6)
