"""Tests that every function refuses anything but a gymnax environment in one line."""

import gymnasium
import gymnax
import pytest

import rtd3jax as rtd
from rtd3jax.envs.rover.environment import Rover


class Brax:
    """As MuJoCo Playground's environments look from outside."""

    action_size, observation_size = 2, 3

    def reset(self, rng):
        raise AssertionError("never played")

    step = reset


class NoDefaults:
    """A gymnax environment but for its default parameters."""

    reset = step = action_space = lambda self, *_: None


WRONG = {
    "gymnasium": (gymnasium.make("Pendulum-v1"), "is a Gymnasium environment.*run_in_gymnasium"),
    "name": ("pendulum", r"is a name, not an environment: .* rtd.make\('pendulum'\)"),
    "tuple": (gymnax.make("Pendulum-v1"), r"gymnax.make returns \(env, params\); pass env"),
    "class": (Rover, r"Rover is a class, .* Rover\(\)"),
    "brax": (Brax(), "wrap it by rtd.from_brax"),
    "nothing": (None, "NoneType has no method reset"),
    "bare": (NoDefaults(), "no default_params.*pass params="),
}
ENTRIES = {
    "check_env": rtd.check_env,
    "train": lambda env: rtd.train(env, rtd.Config(), progress=False),
    "evaluate": lambda env: rtd.evaluate(rtd.constant_policy([0.0]), env),
    "random_policy": rtd.random_policy,
    "to_gymnasium": rtd.to_gymnasium,
    "disturb": lambda env: rtd.disturb(env, rtd.Dropout()),
}


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("what", WRONG)
def test_it_is_one_line_with_the_remedy(what, entry):
    wrong, match = WRONG[what]
    with pytest.raises(rtd.UserError, match=match) as error:
        ENTRIES[entry](wrong)
    assert "\n" not in str(error.value)


def test_a_gymnasium_environment_is_not_registered():
    with pytest.raises(rtd.UserError, match="is a Gymnasium environment"):
        rtd.register("wrong", WRONG["gymnasium"][0])
