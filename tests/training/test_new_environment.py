"""Trains on an environment outside the package, with terminations."""

import jax
import jax.numpy as jnp
import numpy as np
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


def test_a_new_environment_trains_and_its_terminations_count():
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
