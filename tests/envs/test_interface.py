"""Tests which environments `describe` accepts, and that every refusal is one clear line."""

import dataclasses
from typing import ClassVar

import gymnasium
import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces

from rtd3jax.envs.builtin import DISTURBANCES
from rtd3jax.envs.interface import action_bounds, describe
from rtd3jax.envs.registry import make
from rtd3jax.errors import UserError


@struct.dataclass
class State:
    time: jax.Array


@struct.dataclass
class Params:
    max_steps_in_episode: int = 5


class Good(environment.Environment):
    """The smallest environment; the tests below break one thing each."""

    space: ClassVar = spaces.Box(-1.0, 2.0, (1,))

    @property
    def default_params(self):
        return Params()

    def reset_env(self, key, params):
        return self.observation(), State(time=jnp.zeros((), jnp.int32))

    def step_env(self, key, state, action, params):
        state = State(time=state.time + 1)
        return self.observation(), state, self.reward(action), jnp.array(False), {}

    def observation(self):
        return jnp.zeros(3)

    def reward(self, action):
        return jnp.sum(action)

    def is_terminated(self, state, params):
        return jnp.array(False)

    def action_space(self, params):
        return self.space


def refused(env, match):
    with pytest.raises(UserError, match=match) as caught:
        describe(env, env.default_params if hasattr(env, "default_params") else None)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_state_that_changes_its_type_is_refused():
    class Changing(Good):
        def step_env(self, key, state, action, params):
            state = State(time=state.time + 1.0)
            return self.observation(), state, self.reward(action), jnp.array(False), {}

        def step(self, key, state, action, params=None):  # gymnax's own would convert
            found = self.step_env(key, state, action, params)
            return *found[:4], jnp.array(False), {"final_observation": found[0]}

    refused(Changing(), r"state\.time is int32\[\] after reset and float32\[\] after step")


def test_an_environment_that_cannot_be_hashed_is_refused_with_the_reason():
    @dataclasses.dataclass
    class Data(Good):
        gain: float = 1.0

    assert "frozen=True" in refused(Data(), r"cannot be hashed \(unhashable type: 'Data'\)")


def test_a_good_environment_is_measured():
    interface = describe(Good(), Params())
    assert (interface.observation_size, interface.action_shape, interface.action_size) == (
        3,
        (1,),
        1,
    )
    assert interface.action_low.dtype == np.float32
    np.testing.assert_array_equal(interface.action_low, [-1])
    np.testing.assert_array_equal(interface.action_high, [2])


def test_actions_of_any_shape_are_flattened():
    class Matrix(Good):
        space = spaces.Box(-1.0, 1.0, (2, 3))

    interface = describe(Matrix(), Params())
    assert (interface.action_shape, interface.action_size) == ((2, 3), 6)
    assert interface.action_low.shape == interface.action_high.shape == (6,)


@pytest.mark.parametrize(
    ("env_id", "observation", "action", "high"),
    [
        ("MountainCarContinuous-v0", 2, 1, 1.0),
        ("PointRobot-misc", 6, 2, 0.1),
        ("Pendulum-v1", 3, 1, 2.0),
    ],
)
def test_gymnax_environments_are_measured(env_id, observation, action, high):
    for env, params in (gymnax.make(env_id), (make(env_id), make(env_id).default_params)):
        interface = describe(env, params)
        assert (interface.observation_size, interface.action_size) == (observation, action)
        np.testing.assert_allclose(interface.action_high, high)
        np.testing.assert_allclose(interface.action_low, -high)


@pytest.mark.parametrize(
    ("env_id", "disturbance"), [(env, d) for env, ids in DISTURBANCES.items() for d in ids]
)
def test_our_environments_are_measured(env_id, disturbance):
    env = make(env_id, disturbance)
    interface = describe(env, env.default_params)
    full = {"pendulum": 3, "rover": 2}[env_id]
    assert interface.observation_size == full - (disturbance == "hidden")
    assert env.observation_space(env.default_params).shape == (interface.observation_size,)
    assert interface.action_size == {"pendulum": 1, "rover": 2}[env_id]
    np.testing.assert_array_equal(interface.action_high, {"pendulum": 2.0, "rover": 1.0}[env_id])


def test_bounds_follow_traced_parameters():
    env = make("pendulum")
    params = env.default_params

    @jax.jit
    def bounds(torque):
        return action_bounds(env, params.replace(env=params.env.replace(max_torque=torque)))

    low, high = bounds(jnp.float32(3.0))
    np.testing.assert_array_equal(low, [-3.0])
    np.testing.assert_array_equal(high, [3.0])


def test_nothing_is_compiled_or_run():
    class Eager(Good):
        def reward(self, action):
            assert isinstance(action, jax.core.Tracer)
            return super().reward(action)

    describe(Eager(), Params())


def test_something_that_is_no_environment():
    assert "gymnax" in refused(object(), "no method reset")


def test_a_gymnasium_environment():
    message = refused(gymnasium.make("Pendulum-v1"), "is a Gymnasium environment")
    assert "rtd.from_gymnasium" in message


def test_the_old_five_values():
    class Old(Good):
        def step(self, key, state, action, params=None):
            observation, state, reward, done, info = self.step_env(key, state, action, params)
            return observation, state, reward, done, info

    assert "gymnax 1.0" in refused(Old(), "five values")


def test_another_number_of_values():
    class Three(Good):
        def step(self, key, state, action, params=None):
            return self.step_env(key, state, action, params)[:3]

    refused(Three(), "3 values")


def test_no_final_observation():
    class Hiding(Good):
        def step(self, key, state, action, params=None):
            return (*super().step(key, state, action, params)[:5], {})

    refused(Hiding(), "final_observation")


def test_discrete_actions():
    class Discrete(Good):
        space = spaces.Discrete(3)

    assert "Box" in refused(Discrete(), "discrete")


def test_a_tuple_of_actions():
    class Several(Good):
        space = spaces.Tuple((spaces.Box(-1.0, 1.0, (1,)),))

    refused(Several(), "not a Box")


@pytest.mark.parametrize("bound", [np.inf, np.nan])
def test_unbounded_actions(bound):
    class Unbounded(Good):
        space = spaces.Box(-1.0, bound, (1,))

    refused(Unbounded(), "unbounded")


@pytest.mark.parametrize("bound", [np.finfo(np.float32).max, 3e38, 1e20])
def test_bounds_that_mean_no_limit(bound):
    class NoLimit(Good):
        space = spaces.Box(-bound, bound, (1,))

    assert "the range that the plant can use" in refused(NoLimit(), "bounds reach")


def test_large_bounds_are_bounds():
    class Large(Good):
        space = spaces.Box(-9e19, 9e19, (1,))

    describe(Large(), Large().default_params)


def test_empty_range_of_actions():
    class Empty(Good):
        space = spaces.Box(1.0, 1.0, (1,))

    refused(Empty(), "low < high")


@pytest.mark.parametrize(
    ("observation", "match"),
    [
        ({"a": jnp.zeros(2)}, "one float array"),
        (jnp.zeros(3, jnp.int32), "float32"),
        (jnp.zeros((2, 2)), "flatten"),
        (jnp.zeros(()), "flatten"),
    ],
)
def test_observations_that_are_not_a_float_vector(observation, match):
    class Odd(Good):
        def observation(self):
            return observation

    refused(Odd(), match)


def test_a_reward_that_is_not_scalar():
    class Vector(Good):
        def reward(self, action):
            return action

    refused(Vector(), "reward must be a scalar")


@pytest.mark.parametrize("where", ["reset", "step", "action_space"])
def test_an_error_inside_is_one_line_with_its_place(where):
    def fail(*args):
        raise KeyError("first line\nsecond line")

    broken = type("Broken", (Good,), {where if where == "action_space" else f"{where}_env": fail})
    message = refused(broken(), f"environment Broken failed in {where}: KeyError: ")
    assert "first line" in message
