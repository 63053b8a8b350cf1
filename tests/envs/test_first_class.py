"""Tests that a user's environment has all features of the package's environments."""

import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from flax import struct
from gymnax.environments import environment, spaces

import rtd3jax as rtd
from rtd3jax import report, sweep
from rtd3jax.envs import registry
from rtd3jax.study import references


class Leak(rtd.Process):
    """What drains from the tank at a step, m: another level in every episode."""

    most: float = 0.04

    def init(self, key, horizon, size):
        return self.most * jax.random.uniform(key, (), jnp.float32)

    def step(self, key, state, signal):
        return signal - state, state


class TankParams(struct.PyTreeNode):
    max_steps_in_episode: int = 30
    target: float = 0.5
    step: float = 2.0
    leak: rtd.Process = rtd.Nothing()


class TankState(struct.PyTreeNode):
    time: jax.Array
    level: jax.Array
    leak: object


class Tank(environment.Environment):
    """Hold a level; the observation [1] is its error, the action [1] adds water."""

    @property
    def default_params(self):
        return TankParams()

    def reset_env(self, key, params):
        level = jnp.zeros((1,))
        leak = params.leak.init(key, params.max_steps_in_episode, 1)
        return level - params.target, TankState(jnp.int32(0), level, leak)

    def step_env(self, key, state, action, params):
        filled = state.level + 0.1 * jnp.clip(action, 0.0, 1.0)
        level, leak = params.leak.step(key, state.leak, filled)
        error = level - params.target
        reward = -jnp.sum(error**2)
        return error, TankState(state.time + 1, level, leak), reward, jnp.bool_(False), {}

    def observed_reward(self, observation, action, params):
        return -jnp.sum(observation**2)

    def action_space(self, params):
        return spaces.Box(0.0, 1.0, (1,))

    @property
    def name(self):
        return "tank"


@struct.dataclass
class Proportional:
    """Adds water in proportion to what is missing."""

    def init(self, key=None):
        return ()

    def step(self, state, observation):
        return jnp.clip(-10.0 * observation, 0.0, 1.0), state


def best_return(env, episodes, seed):
    if env.default_params.env.leak != rtd.Nothing():
        raise rtd.UserError("the ceiling of a tank that leaks is not known")
    return Proportional()


def hidden(state):
    return None if isinstance(state.leak, tuple) else state.leak


FACTS = {
    "positive": ("target",),
    "reward_from_observation": ("noise",),
    "baselines": {
        "closed": lambda env: [0.0],
        "proportional": lambda env: Proportional(),
    },
    "ceiling": best_return,
    "drawing": rtd.Drawing(
        observation=("level error",),
        action=("pump",),
        constants=("target",),
        step_seconds="step",
        hidden=hidden,
        hidden_name="leak",
        hidden_elements=("drain",),
    ),
}
DISTURBANCES = {"leaky": ("leak", Leak()), "noise": rtd.GaussianNoise(sigma=0.01)}


@pytest.fixture
def tank(monkeypatch):
    """The tank under its name, and the environment."""
    monkeypatch.setattr(registry, "_entries", dict(registry._entries))
    env = Tank()
    rtd.register("tank", env, DISTURBANCES, **FACTS)
    return env


def test_a_process_within_the_dynamics_is_a_channel(tank):
    env = rtd.make("tank", "leaky+dropout", most=0.02, p=0.5, target=0.4)
    params = env.default_params
    assert params.env.leak == Leak(0.02) and params.env.target == 0.4
    assert params.observation == rtd.Dropout(p=0.5)
    assert rtd.make("tank").default_params.env.leak == rtd.Nothing()
    with pytest.raises(rtd.UserError, match="target=0.0 must be greater than 0"):
        rtd.make("tank", target=0.0)


def test_the_rule_of_the_reward_is_the_environments(tank):
    assert rtd.make("tank", "leaky").reward_from == "state"
    assert rtd.make("tank", "leaky+noise").reward_from == "observation"
    assert rtd.make("tank", "noise", reward_from="state").reward_from == "state"


def test_its_ceiling_is_the_best_policys_return(tank):
    best = rtd.ceiling(rtd.make("tank"), episodes=4)
    expected = rtd.evaluate(Proportional(), rtd.make("tank"), episodes=4)
    assert best.kind == "exact" and best.mean == pytest.approx(float(expected.mean()))
    assert rtd.ceiling(tank_of(best), episodes=2) == best


def test_a_ceiling_that_fails_is_one_line(tank):
    rtd.register("tank", tank, ceiling=lambda env, episodes, seed: env.nothing)
    with pytest.raises(rtd.UserError, match="the ceiling of tank failed: .*nothing"):
        rtd.ceiling(rtd.make("tank"))


def tank_of(best):
    """A tank whose registered ceiling is a value."""
    env = Tank()
    rtd.register("other-tank", env, ceiling=lambda *_: best)
    return env


def test_a_sweep_and_its_page_show_what_is_known_of_it(tank, tmp_path):
    out = tmp_path / "run"
    small = "--total-steps 60 --hidden-size 8 --batch-size 8 --learning-starts 10 --eval-every 30"
    which = "--env tank --disturbances none leaky --algorithms td3 --seeds 1 --final-episodes 2"
    assert sweep.main([*which.split(), *small.split(), "--quiet", "--out", str(out)]) == 0
    episodes = pd.read_parquet(out / "episodes.parquet")
    assert set(episodes["algorithm"]) == {"td3", "random", "closed", "proportional"}
    summary = (out / "summary.md").read_text()
    order = [summary.index(f"| {name} (reference)") for name in ("random", "closed")]
    assert order == sorted(order) and "| proportional (reference)" in summary
    assert report.main([str(out)]) == 0
    page = (out / "report.html").read_text()
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.S)[1])
    still, leaky = data["environments"]
    named = [reference["name"] for reference in leaky["references"]]
    assert named == ["random", "closed", "proportional"]
    assert still["ceiling"]["kind"] == "exact" and "leaks" in leaky["ceiling"]["missing"]
    closed, proportional = (reference["return"] for reference in still["references"][1:])
    assert closed == pytest.approx(-30 * 0.25) and closed < proportional
    assert proportional == pytest.approx(still["ceiling"]["mean"], rel=1e-4)
    first, second = data["playback"]
    assert first["names"] == ["level error"] and first["actions"] == ["pump"]
    assert first["constants"] == {"target": 0.5} and first["seconds"] == 2.0
    assert first["hidden"] is None and "hidden" not in first["runs"][0]
    assert second["hidden"] == {"name": "leak", "elements": ["drain"]}
    assert np.ptp(second["runs"][0]["hidden"]["scale"]) == 0


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"positive": ("targt",)}, "no parameter 'targt'; did you mean 'target'"),
        ({"reward_from_observation": ("nois",)}, "no disturbance 'nois'; did you mean 'noise'"),
        ({"baselines": {"random": lambda env: [0.0]}}, "a baseline cannot be called 'random'"),
        ({"baselines": {"still": [0.0]}}, r"baseline 'still' must be a function, not \[0.0\]"),
        ({"ceiling": -1.0}, "ceiling must be a function, not -1.0"),
        ({"drawing": "pendulum"}, "drawing must be an rtd.Drawing"),
        ({"drawing": rtd.Drawing(constants=("mass",))}, "no parameter 'mass'"),
    ],
)
def test_mistakes_are_named(tank, changed, match):
    with pytest.raises(rtd.UserError, match=match) as caught:
        rtd.register("tank", Tank(), DISTURBANCES, **{**FACTS, **changed})
    assert "\n" not in str(caught.value)
    assert rtd.make("tank", "leaky").base is tank, "what failed replaced nothing"


def test_a_function_has_none_of_it(tank):
    with pytest.raises(rtd.UserError, match="for an environment, not for a function"):
        rtd.register("made", lambda disturbance: Tank(), ceiling=best_return)


@pytest.mark.parametrize(
    ("name", "baseline", "match"),
    [
        ("broken", lambda env: env.nothing, "the baseline 'broken' of tank failed: .*nothing"),
        ("td3", lambda env: [0.0], "the baseline 'td3' of tank has the name of an agent"),
        ("wide", lambda env: [0.0, 1.0], r"action has shape \(2,\)"),
    ],
)
def test_a_baseline_that_does_not_fit_is_one_line(tank, name, baseline, match):
    rtd.register("tank", Tank(), baselines={name: baseline})
    cell = rtd.Cell("tank", "none", rtd.Config(algorithm="td3"))
    with pytest.raises(rtd.UserError, match=match):
        references.references_on(cell)


@pytest.mark.parametrize("env_id", rtd.ENVIRONMENTS)
def test_ours_stay_whoever_asks(tank, env_id):
    with pytest.raises(rtd.UserError, match="exists already; choose another id"):
        rtd.register(env_id, Tank(), replace=True)


class Labelled(Tank):
    """Declares a number of levels, although it shows a vector."""

    def observation_space(self, params):
        return spaces.Discrete(4)


def test_a_vector_that_is_declared_as_a_number_can_be_disturbed():
    env = rtd.disturb(Labelled(), rtd.GaussianNoise(sigma=0.1))
    observation, _ = env.reset(jax.random.key(0), env.default_params)
    assert env.observation_space().shape == observation.shape == (1,)


class Kept(Tank):
    """A tank whose default parameters are given; two objects are two environments."""

    def __init__(self, params=None):
        super().__init__()
        self.params = params

    @property
    def default_params(self):
        return TankParams() if self.params is None else self.params


class Equal(rtd.ValueIdentity, Kept):
    """Equal to any other one."""


class Numbered(Equal):
    """Equal to those with the same target."""

    def identity(self):
        return (self.default_params.target,)


def unable(params):
    raise TypeError("no tank")


@pytest.mark.parametrize(
    ("env", "with_params", "match"),
    [
        (Kept(), Kept, "not equal to the registered one, .* let Kept inherit from rtd.ValueId"),
        (Equal(), Kept, "not equal"),
        (Equal(), unable, "with_params failed: no tank"),
    ],
)
def test_what_is_known_of_an_environment_is_not_lost_with_other_parameters(
    tank, env, with_params, match
):
    with pytest.raises(rtd.UserError, match=match) as caught:
        rtd.register("kept", env, ceiling=best_return, with_params=with_params)
    assert "\n" not in str(caught.value) and "kept" not in registry._entries
    best = rtd.Ceiling(-1.0, 0.0, "exact")
    rtd.register("kept", Equal(), ceiling=lambda *_: best, with_params=Equal)
    assert rtd.ceiling(rtd.make("kept", target=0.4), episodes=2) == best
    rtd.register("numbered", Numbered(), ceiling=lambda *_: best, with_params=Numbered)
    assert rtd.ceiling(rtd.make("numbered"), episodes=2) == best
    with pytest.raises(rtd.UserError, match="without numeric parameters in its identity"):
        rtd.make("numbered", target=0.4)


def test_a_default_process_that_make_would_remove_is_refused(tank):
    env = Kept(TankParams(leak=Leak(0.01)))
    with pytest.raises(rtd.UserError, match="have a Leak as leak, .*NoDisturbance.. the default"):
        rtd.register("kept", env, DISTURBANCES)
    rtd.register("kept", env, {"noise": rtd.GaussianNoise()})  # no disturbance replaces the leak
    assert rtd.make("kept", "noise").default_params.env.leak == Leak(0.01)
