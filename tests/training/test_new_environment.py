"""Trains on an environment outside the package, with terminations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces

import rtd3jax as rtd


@struct.dataclass
class State:
    time: jax.Array
    position: jax.Array


class Cart(environment.Environment):
    """Push a point to the origin; beyond 1 m the episode terminates."""

    @property
    def default_params(self):
        return environment.EnvParams(max_steps_in_episode=20)

    def reset_env(self, key, params):
        position = jax.random.uniform(key, (), jnp.float32, -0.5, 0.5)
        return position[None], State(jnp.int32(0), position)

    def step_env(self, key, state, action, params):
        position = state.position + 0.2 * jnp.clip(action[0], -1.0, 1.0)
        state = State(state.time + jnp.int32(1), position)
        terminated = jnp.abs(position) > 1.0
        reward = -(position**2) - 5.0 * terminated
        return position[None], state, reward, terminated, {}

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (1,))


class OneStep(Cart):
    """Episodes of one step with a reward of one; they end by a termination or by a time limit."""

    def __init__(self, terminates):
        super().__init__()
        self.terminates = terminates

    def step_env(self, key, state, action, params):
        observation, state, _, _, info = super().step_env(key, state, action, params)
        return observation, state, jnp.float32(1.0), jnp.asarray(self.terminates), info

    def is_truncated(self, state, params):
        return jnp.asarray(not self.terminates)


@pytest.mark.parametrize("terminates", [True, False])
def test_a_target_has_a_value_after_a_time_limit_but_not_after_a_termination(terminates):
    config = rtd.Config(
        algorithm="td3",
        total_steps=400,
        hidden_size=8,
        batch_size=16,
        learning_starts=20,
        gamma=0.5,
        tau=0.2,
        eval_every=100,
        eval_episodes=1,
    )
    run = rtd.train(OneStep(terminates), config, [0], progress=False)
    np.testing.assert_array_equal(run.returns, 1.0)
    target = run.metrics["target"][0, -1]
    # The value of a reward of one per step without end is 1 / (1 - gamma).
    assert target == pytest.approx(1.0 if terminates else 2.0, rel=0.1)


def test_a_new_environment_trains():
    env = Cart()
    config = rtd.Config(
        algorithm="lstm-td3-1ha2hc",
        history_length=2,
        total_steps=3_000,
        hidden_size=16,
        batch_size=32,
        learning_starts=200,
        eval_every=1_500,
    )
    run = rtd.train(env, config, [0], progress=False)
    random = rtd.evaluate(rtd.random_policy(env), env, episodes=50)
    assert run.returns[0, -1] > -2.0 > float(np.mean(random))


class Constant:
    """An environment that only has the methods of gymnax, and whose step returns Python numbers."""

    default_params = environment.EnvParams(max_steps_in_episode=5)

    def reset(self, key, params=None):
        return jax.random.uniform(key, (2,)), jnp.int32(0)

    def step(self, key, state, action, params=None):
        first, start = self.reset(key)
        truncated = state >= 4
        seen = jnp.where(truncated, first, jnp.zeros(2))
        after = jnp.where(truncated, start, state + 1)
        return seen, after, -1.0, False, truncated, {"final_observation": jnp.zeros(2)}

    def action_space(self, params=None):
        return spaces.Box(-1.0, 1.0, (1,))


def test_rewards_and_terminations_may_be_python_numbers():
    env = Constant()
    rtd.check_env(env)
    config = rtd.Config(
        "td3", total_steps=20, learning_starts=10, batch_size=4, hidden_size=4, eval_every=20
    )
    assert rtd.train(env, config, [0], progress=False).returns.tolist() == [[-5.0]]


class Broken(Cart):
    """Its sensor fails at the fifth step."""

    def step_env(self, key, state, action, params):
        observation, state, reward, terminated, info = super().step_env(key, state, action, params)
        return jnp.where(state.time > 5, jnp.nan, observation), state, reward, terminated, info


def test_nan_from_an_environment_is_reported_as_its_own():
    config = rtd.Config(
        algorithm="td3",
        total_steps=100,
        hidden_size=4,
        batch_size=4,
        learning_starts=10,
        eval_every=50,
    )
    run = rtd.train(Broken(), config, [0], progress=False)
    assert (
        "environment returned an observation or reward that is not finite" in run.failures[0].reason
    )
    assert run.failures[0].step < 10 and np.isnan(run.returns).all()
