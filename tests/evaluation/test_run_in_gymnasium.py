"""Tests that a policy has equal returns on Gymnasium's pendulum and on ours."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import rtd3jax as rtd
from rtd3jax.agents.agent import make_part
from rtd3jax.agents.bounds import Bounds
from rtd3jax.agents.networks import init_network
from rtd3jax.errors import UserError
from rtd3jax.registries import AGENTS


@struct.dataclass
class Swing:
    """Pumps energy until the top is near, then holds it."""

    observation_size: int = struct.field(pytree_node=False, default=3)

    def init(self, key=None):
        return jnp.int32(0)

    def step(self, state, observation):
        cos, sin, speed = observation
        lack = 15.0 * (1.0 - cos) - 0.5 * speed**2  # of energy, against rest at the top
        pump = 2.0 * jnp.sign(speed + 1e-3) * jnp.sign(lack)
        hold = -12.0 * jnp.arctan2(sin, cos) - 3.0 * speed
        torque = jnp.clip(jnp.where(cos > 0.9, hold, pump), -2.0, 2.0)
        return torque[None], state + jnp.int32(1)


class Plain:
    """Not a pytree."""

    init = Swing.init
    step = Swing.step


def test_its_returns_are_those_of_our_pendulum():
    ours = np.asarray(rtd.evaluate(Swing(), rtd.make("pendulum"), episodes=2_000))
    theirs = rtd.run_in_gymnasium(Swing(), "Pendulum-v1", episodes=60, seed=0)
    assert theirs.shape == (60,) and theirs.dtype == np.float64
    assert ours.mean() > -500, "a policy that can do it"
    error = np.hypot(ours.std() / np.sqrt(2_000), theirs.std() / np.sqrt(60))
    assert abs(ours.mean() - theirs.mean()) < 4 * error


def test_from_one_state_both_pendulums_go_the_same_way():
    env, swing = rtd.make("pendulum"), Swing()
    theirs = gymnasium.make("Pendulum-v1").unwrapped
    observation, state = env.reset(jax.random.key(2))
    theirs.reset(seed=0)
    theirs.state = np.array([state.env.theta, state.env.theta_dot], np.float64)
    for step in range(50):
        action, _ = swing.step(jnp.int32(0), observation)
        observation, state, reward, *_ = env.step(jax.random.key(step), state, action)
        seen, their_reward, *_ = theirs.step(np.asarray(action))
        np.testing.assert_allclose(observation, seen, atol=2e-3)
        assert float(reward) == pytest.approx(float(their_reward), abs=2e-2)


def test_a_recurrent_policy_plays_with_its_window():
    policy = rtd.Policy(
        actor=init_network(
            jax.random.key(0), make_part(AGENTS["lstm-td3-1ha1hc"], "actor", "lstm", 3, 1, 8)
        ),
        bounds=Bounds(jnp.array([-2.0]), jnp.array([2.0])),
        history_length=jnp.int32(2),
        centre_token=jnp.zeros(1),
        algorithm="lstm-td3-1ha1hc",
        window_tokens=2,
        observation_size=3,
        action_shape=(1,),
    )
    one = rtd.run_in_gymnasium(policy, "Pendulum-v1", episodes=1, seed=5)
    two = rtd.run_in_gymnasium(policy, gymnasium.make("Pendulum-v1"), episodes=2, seed=5)
    assert one[0] == two[0] != two[1]
    env = gymnasium.make("Pendulum-v1")
    observation, _ = env.reset(seed=int(np.random.SeedSequence(5).generate_state(1)[0]))
    state, total, truncated = policy.init(), 0.0, False
    step = jax.jit(policy.step)
    while not truncated:
        action, state = step(state, observation)
        observation, reward, _, truncated, _ = env.step(np.asarray(action))
        total += float(reward)
    assert int(state.time) == 200 and one[0] == pytest.approx(total, rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ((Swing(), "Pendulum-v9"), "Gymnasium cannot make 'Pendulum-v9'"),
        ((Swing(), "Pendulum v1:::"), "Gymnasium cannot make 'Pendulum v1:::'"),
        ((Swing(), "CartPole-v1"), "needs a Box"),
        ((Swing(), "MountainCarContinuous-v0"), "expects 3 observation elements"),
        ((rtd.constant_policy([0.0, 0.0]), "Pendulum-v1"), r"shape \(2,\)"),
        ((Swing(), rtd.make("pendulum")), "rtd.evaluate"),
        ((object(), "Pendulum-v1"), "not a policy"),
        ((Plain(), "Pendulum-v1"), "make it a flax.struct.dataclass"),
        ((Swing(), "Pendulum-v1", 0), "episodes"),
        ((Swing(), "Pendulum-v1", 1, -1), "seed"),
    ],
)
def test_misfits_are_named(arguments, match):
    with pytest.raises(UserError, match=match) as caught:
        rtd.run_in_gymnasium(*arguments)
    assert "\n" not in str(caught.value)


class Broken(gymnasium.Wrapper):
    """Its third observation, or its third reward, is not a number."""

    def __init__(self, what):
        super().__init__(gymnasium.make("Pendulum-v1"))
        self.what, self.steps = what, 0

    def step(self, action):
        observation, reward, *rest = super().step(action)
        self.steps += 1
        if self.steps == 3:
            observation = observation * np.nan if self.what == "observation" else observation
            reward = np.nan if self.what == "reward" else reward
        return observation, reward, *rest


@pytest.mark.parametrize(
    ("what", "match"),
    [
        ("observation", r"at step 3 of episode 0 the policy's action is \[nan\]"),
        ("reward", "at step 2 of episode 0 the environment's reward is nan"),
    ],
)
def test_what_is_not_finite_is_refused_with_its_step(what, match):
    with pytest.raises(UserError, match=match):
        rtd.run_in_gymnasium(Swing(), Broken(what), episodes=1)


class Whole(gymnasium.Env):
    """One step, whose reward is the sum of its actions, which are whole numbers."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-2, 2, (2, 1), np.int32)

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert action.dtype == np.int32 and action.shape == (2, 1)
        return np.zeros(1, np.float32), float(action.sum()), True, False, {}


@pytest.mark.parametrize(("action", "total"), [([1.7, -0.6], 1.0), ([9.0, 0.4], 2.0)])
def test_actions_of_whole_numbers_are_rounded_and_shaped_as_in_training(action, total):
    constant = rtd.constant_policy(action)
    function = rtd.function_policy(lambda state, seen: (jnp.asarray(action), state))
    for policy in (constant, function):
        np.testing.assert_array_equal(rtd.run_in_gymnasium(policy, Whole(), episodes=2), total)
    _, state, reward, *_ = _one_step(rtd.from_gymnasium(Whole, max_steps_in_episode=2), action)
    assert float(reward) == total


def _one_step(env, action):
    params = env.default_params
    _, state = env.reset(jax.random.key(0), params)
    return env.step(jax.random.key(1), state, jnp.asarray(action).reshape(2, 1), params)
