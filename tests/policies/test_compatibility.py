"""Tests that a policy with other shapes is refused, and that other bounds give a warning."""

import warnings

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from random_policies import random_policy

import rtd3jax as rtd
from rtd3jax.envs.controllers.lqr import LinearPolicy
from rtd3jax.policies.compatibility import fitted
from rtd3jax.study.report.playback import record_episodes

CAR, ROVER, PENDULUM = "MountainCarContinuous-v0", "rover", "pendulum"
"""Actions of 1, 2 and 1 elements; observations of 2, 2 and 3."""


@struct.dataclass
class Own:
    """A user's policy, which says nothing of its shapes."""

    def init(self, key=None):
        return ()

    def step(self, state, observation):
        return observation[:1], state


MEETINGS = {
    "evaluate": lambda policy, env: rtd.evaluate(policy, env, episodes=2),
    "playback": lambda policy, env: record_episodes(policy, env, 1, 0, 2),
    "gymnasium": lambda policy, env: rtd.run_in_gymnasium(policy, rtd.to_gymnasium(env), 1),
}


@pytest.mark.parametrize("meeting", MEETINGS)
@pytest.mark.parametrize("kind", ["trained", "random", "constant", "own"])
def test_actions_of_another_shape_are_refused(kind, meeting):
    car = rtd.make(CAR)
    policy = {
        "trained": lambda: random_policy("td3", car),
        "random": lambda: rtd.random_policy(car),
        "constant": lambda: rtd.constant_policy([0.0]),
        "own": Own,
    }[kind]()
    with pytest.raises(rtd.UserError, match=r"action has shape \(1,\), the environment's \(2,\)"):
        MEETINGS[meeting](policy, rtd.make(ROVER))


@pytest.mark.parametrize("meeting", MEETINGS)
def test_observations_of_another_size_are_refused(meeting):
    policy = random_policy("td3", rtd.make(CAR))
    with pytest.raises(rtd.UserError, match="expects 2 observation elements, .* gives 3"):
        MEETINGS[meeting](policy, rtd.make(PENDULUM))


def test_other_bounds_are_said():
    policy = rtd.random_policy(rtd.make(PENDULUM, max_torque=1.0))
    with pytest.warns(UserWarning, match=r"go from \[-1.0\] to \[1.0\], .* from \[-2.0\] to"):
        rtd.run_in_gymnasium(policy, gymnasium.make("Pendulum-v1", max_episode_steps=1), 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        own = rtd.make(PENDULUM, max_torque=1.0, max_steps_in_episode=1)
        rtd.evaluate(policy, own, episodes=1)


class Plain:
    """A user's controller that is not a dataclass of flax."""

    def init(self, key=None):
        return ()

    def step(self, state, observation):
        return observation[:1], state


@pytest.mark.parametrize("meeting", MEETINGS)
@pytest.mark.parametrize(
    ("policy", "match"),
    [
        (Plain(), "Plain cannot be compiled; make it a flax.struct.dataclass"),
        (Own, "Own is a class; pass an instance of it"),
    ],
)
def test_a_policy_that_cannot_be_compiled_is_named(policy, match, meeting):
    with pytest.raises(rtd.UserError, match=match):
        MEETINGS[meeting](policy, rtd.make(PENDULUM))


def test_a_regulator_gets_the_shape_of_the_actions():
    """It has a field ``action``, too, which is only the equilibrium's part of its actions."""
    two = jnp.ones(2)
    policy = LinearPolicy(jnp.ones((2, 3)), jnp.zeros(3), 0 * two, -two, two, (2, 1), 3)
    assert fitted(policy, (2, 1)) is policy
    constant = fitted(rtd.constant_policy([0.5, 0.0]), (2, 1))
    np.testing.assert_array_equal(constant.action, [[0.5], [0.0]])


def test_what_is_no_policy_is_named():
    with pytest.raises(rtd.UserError, match="float is not a policy"):
        rtd.evaluate(1.0, rtd.make(ROVER))
    assert rtd.evaluate(rtd.constant_policy(jnp.zeros(2)), rtd.make(ROVER), episodes=1).shape == (
        1,
    )
