"""Tests of environments by name, and of their static parts."""

import dataclasses
import functools
import itertools
import warnings

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces

from rtd3jax.envs import registry
from rtd3jax.envs.builtin import DISTURBANCES, ENVIRONMENTS
from rtd3jax.envs.description import Ceiling
from rtd3jax.envs.disturbed import Disturbed, disturb
from rtd3jax.envs.entry import parameters_of
from rtd3jax.envs.parameters import parse_disturbance
from rtd3jax.envs.processes.disturbances import GaussianNoise, Hidden, Pulses, Sine
from rtd3jax.envs.processes.faults import Delay, Dropout
from rtd3jax.envs.processes.process import Chain
from rtd3jax.envs.registry import make, register
from rtd3jax.envs.rover import Rover, RoverParams
from rtd3jax.envs.rover.slip import Ar1Slip
from rtd3jax.errors import UserError, nearest

ALL = [(env, disturbance) for env in ENVIRONMENTS for disturbance in DISTURBANCES[env]]


def aval(tree):
    return jax.tree.map(lambda x: (x.shape, str(x.dtype), bool(x.weak_type)), tree)


@pytest.mark.parametrize(("env_id", "disturbance"), [*ALL, ("MountainCarContinuous-v0", "none")])
def test_a_state_keeps_its_types_from_reset_to_step(env_id, disturbance):
    env = make(env_id, disturbance)
    key = jax.random.key(0)
    action = jnp.zeros(env.action_space(env.default_params).shape)
    first, state = jax.eval_shape(env.reset, key, env.default_params)
    after, evolved, reward, *_ = jax.eval_shape(env.step, key, state, action, env.default_params)
    assert aval(state) == aval(evolved)
    assert aval(first) == aval(after)
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(state))
    assert reward.shape == ()
    assert reward.dtype == jnp.float32
    inside = jax.eval_shape(env.reset_env, key, env.default_params)[1]
    if env_id in ENVIRONMENTS:
        assert aval(inside) == aval(state), "step_env and reset_env can be looped over too"


def test_equal_structure_is_equal_whatever_the_numbers():
    assert make("pendulum", "noise", sigma=0.1) == make("pendulum", "noise", sigma=2.0)
    assert hash(make("pendulum", "noise", sigma=0.1)) == hash(make("pendulum", "noise"))
    assert make("rover", "ar1-slip") == make("rover", "ar1-slip-fast", wheelbase=0.7)
    assert make("PointRobot-misc") == make("PointRobot-misc", max_force=0.2)


def test_different_structure_is_different():
    envs = [
        make("pendulum", "noise"),
        make("pendulum", "noise", reward_from="state"),
        make("rover"),
        make("MountainCarContinuous-v0"),
        make("PointRobot-misc"),
        make("Pendulum-v1"),
    ]
    for one, other in itertools.combinations(envs, 2):
        assert one != other
    assert make("pendulum") != "pendulum"


def test_transition_gradients_are_part_of_the_identity():
    env = make("Pendulum-v1")
    assert env.with_transition_gradients() != env
    assert env.with_transition_gradients().default_params == env.default_params


def test_equal_environments_share_a_program():
    traces = []

    @functools.partial(jax.jit, static_argnames="env")
    def first(env, key, params):
        traces.append(env)
        return env.reset(key, params)[0]

    for sigma in (0.1, 0.7):
        env = make("pendulum", "noise", sigma=sigma)
        first(env, jax.random.key(0), env.default_params)
    assert len(traces) == 1
    env = make("pendulum", "random-sine")
    first(env, jax.random.key(0), env.default_params)
    assert len(traces) == 2


@pytest.mark.parametrize(
    ("env_id", "disturbance", "name", "values"),
    [
        ("pendulum", "noise", "sigma", (0.0, 5.0)),
        ("rover", "ar1-slip", "target_speed", (0.5, 0.1)),
        ("PointRobot-misc", "none", "circle_radius", (1.0, 5.0)),
    ],
)
def test_default_parameters_are_each_environments_own(env_id, disturbance, name, values):
    """Inside gymnax's own jit the first of two equal environments would decide for both."""
    key = jax.random.key(0)
    firsts, afters = [], []
    for value in values:
        env = make(env_id, disturbance, **{name: value})
        first, state = env.reset(key)
        explicit, _ = env.reset(key, env.default_params)
        np.testing.assert_array_equal(first, explicit)
        action = jnp.zeros(env.action_space(env.default_params).shape)
        after = env.step(key, state, action)[0]
        np.testing.assert_array_equal(after, env.step(key, state, action, env.default_params)[0])
        firsts.append(np.asarray(first))
        afters.append(np.asarray(after))
    assert np.max(np.abs(firsts[0] - firsts[1])) > 1e-2
    assert np.max(np.abs(afters[0] - afters[1])) > 1e-2


def test_parameters_go_to_the_process_then_to_the_environment():
    params = make("pendulum", "temporal-bias", count=3, amplitude_max=2, g=9.81).default_params
    assert (params.observation.count, params.observation.amplitude_max, params.env.g) == (
        3,
        2.0,
        9.81,
    )
    assert isinstance(params.observation.amplitude_max, float)
    assert make("pendulum", max_steps_in_episode=50).default_params.max_steps_in_episode == 50
    params = make("rover", "ar1-slip", rho=0.5, wheelbase=1.0).default_params
    assert (params.slip.rho, params.wheelbase) == (0.5, 1.0)
    assert make("PointRobot-misc", dense_reward=True).default_params.dense_reward is True
    assert make("pendulum", "random-sine", elements=1).default_params.observation.elements == (1,)


def test_variants_are_the_papers():
    sigma_rho = {
        name: (process.sigma, process.rho)
        for name in DISTURBANCES["rover"]
        if name.startswith("ar1")
        for process in [make("rover", name).default_params.slip]
    }
    assert sigma_rho == {
        "ar1-slip": (0.05, 0.95),
        "ar1-slip-high-variance": (0.10, 0.95),
        "ar1-slip-fast": (0.05, 0.90),
        "ar1-slip-slow": (0.05, 0.98),
    }
    sine = make("pendulum", "temporal-sine").default_params.observation
    assert sine == Sine(1.0, 1.0, 70.0, 70.0, elements=(0, 1), waves=1)


def test_only_noise_rewards_the_observation_by_default():
    for disturbance in DISTURBANCES["pendulum"]:
        env = make("pendulum", disturbance)
        assert isinstance(env, Disturbed)
        assert env.reward_from == ("observation" if disturbance == "noise" else "state")


@pytest.mark.parametrize(
    ("arguments", "parameters", "match"),
    [
        (("pendulm",), {}, "did you mean 'pendulum'"),
        (("PointRobt-misc",), {}, "did you mean 'PointRobot-misc'"),
        (("pendulum", "noisy"), {}, "did you mean 'noise'"),
        (("rover", "noise"), {}, "unknown disturbance 'noise' of rover"),
        (("pendulum", "noise"), {"sigm": 1.0}, "did you mean 'sigma'"),
        (("pendulum", "noise"), {"reward_fron": "state"}, "did you mean 'reward_from'"),
        (("pendulum", "noise"), {"reward_from": "stat"}, "did you mean 'state'"),
        (("pendulum", "noise"), {"reward_from": 3}, "reward_from"),
        (("pendulum", "noise"), {"sigma": "much"}, "sigma"),
        (("pendulum", "noise"), {"sigma": True}, "sigma"),
        (("pendulum", "noise"), {"sigma": float("nan")}, "sigma"),
        (("pendulum", "noise"), {"sigma": -1}, "sigma"),
        (("pendulum", "temporal-bias"), {"count": 2.5}, "count"),
        (("pendulum", "temporal-bias"), {"elements": (0, 0.5)}, "elements"),
        (("pendulum",), {"max_steps_in_episode": 0}, "max_steps_in_episode"),
        (("pendulum",), {"dt": 0.0}, "dt"),
        (("rover", "ar1-slip"), {"rho": 1.5}, "rho"),
        (("rover", "ar1-slip"), {"slip": 1.0}, "slip"),
        (("rover", "sine-slip"), {"period_min": 100}, "period_min"),
        (("rover",), {"wheelbase": 0}, "wheelbase"),
        (("rover",), {"reward_from": "state"}, "reward_from"),
        (("PointRobot-misc", "noise"), {}, "noise"),
        (("PointRobot-misc",), {"max_forc": 1.0}, "did you mean 'max_force'"),
        (("PointRobot-misc",), {"dense_reward": 1}, "dense_reward"),
    ],
)
def test_mistakes_are_named(arguments, parameters, match):
    with pytest.raises(UserError, match=match) as caught:
        make(*arguments, **parameters)
    assert "\n" not in str(caught.value)


def test_a_gymnax_environment_is_gymnaxs():
    ours, (theirs, params) = (
        make("MountainCarContinuous-v0"),
        gymnax.make("MountainCarContinuous-v0"),
    )
    assert isinstance(ours, type(theirs))
    assert ours.name == theirs.name
    key = jax.random.key(3)
    observation, state = ours.reset(key)
    after = ours.step(key, state, jnp.array([0.5]))
    with jax.numpy_dtype_promotion("standard"):
        expected, their_state = theirs.reset(key, params)
        their_after = theirs.step(key, their_state, jnp.array([0.5]), params)
    np.testing.assert_array_equal(observation, expected)
    np.testing.assert_array_equal(after[0], their_after[0])
    np.testing.assert_array_equal(after[2], their_after[2])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("none", ("none", {})),
        ("noise:", ("noise", {})),
        (
            "noise:sigma=1.0,reward_from=state",
            ("noise", {"sigma": 1.0, "reward_from": "state"}),
        ),
        (
            " random-sine: elements=(0, 1), waves = 2 ",
            ("random-sine", {"elements": (0, 1), "waves": 2}),
        ),
    ],
)
def test_disturbances_are_parsed(text, expected):
    assert parse_disturbance(text) == expected


@pytest.mark.parametrize("text", ["", ":sigma=1", "noise:sigma", "noise:=1", "noise:a=1,a=2", None])
def test_malformed_disturbances_are_refused(text):
    with pytest.raises(UserError):
        parse_disturbance(text)


def test_the_name_of_a_disturbance_may_contain_its_parameters():
    env = make("pendulum", "noise:sigma=1.0,reward_from=state", max_torque=1.5)
    same = make("pendulum", "noise", sigma=1.0, reward_from="state", max_torque=1.5)
    assert env == same and env.default_params == same.default_params
    assert env.default_params.observation.sigma == 1.0 and env.reward_from == "state"
    with pytest.raises(UserError, match="'sigma' is given twice"):
        make("pendulum", "noise:sigma=1.0", sigma=2.0)


def test_registered_environments_are_made(monkeypatch):
    monkeypatch.setattr(registry, "_entries", dict(registry._entries))
    register("mine", lambda disturbance, **parameters: (disturbance, parameters))
    assert make("mine", "wind", speed=2) == ("wind", {"speed": 2})
    with pytest.raises(UserError, match="did you mean 'mine'"):
        make("mines")
    for taken in ("pendulum", "Pendulum-v1"):
        with pytest.raises(UserError, match="exists already"):
            register(taken, lambda disturbance: None)
    for unfit in (3, type(make("rover"))):
        with pytest.raises(UserError, match="must be an environment or a function"):
            register("other", unfit)
    with pytest.raises(UserError, match="not for a function"):
        register("other", lambda disturbance: None, {})


def test_a_registered_environment_gets_parameters_and_disturbances(monkeypatch):
    monkeypatch.setattr(registry, "_entries", dict(registry._entries))
    base = make("PointRobot-misc")
    register("robot", base, {"lag": ("action", Delay(3)), "noise": GaussianNoise()})
    env = make("robot", "lag+noise+dropout", max_force=0.2, sigma=0.1, p=0.5)
    assert env.base is base and env == make("robot", "noise+lag+dropout")
    params = env.default_params
    assert params.env.max_force == 0.2 and params.action == Delay(3)
    assert params.observation == Chain((GaussianNoise(0.1), Dropout(p=0.5)))
    assert make("robot", max_steps_in_episode=7).default_params.max_steps_in_episode == 7
    with pytest.raises(UserError, match="did you mean 'noise'"):
        make("robot", "nois")
    for name in ("dropout", "none", "a+b", "a:b", ""):
        with pytest.raises(UserError, match="cannot be called"):
            register("robot2", base, {name: Delay()})
    for pair in (("action",), ("action", Delay(), 3)):
        with pytest.raises(UserError, match="a process or a pair"):
            register("robot2", base, {"lag": pair})
    with pytest.raises(UserError, match="must be a dict"):
        register("robot2", base, Delay())
    with pytest.raises(UserError, match="element 9"):
        register("robot2", base, {"blind": Hidden(element=9)})


def test_a_cell_that_runs_again_registers_again(monkeypatch):
    monkeypatch.setattr(registry, "_entries", dict(registry._entries))
    base = make("PointRobot-misc")
    cell = compile("register('robot', environment, **how)", "cell", "exec")

    def run(module, environment, **how):
        exec(
            cell, {"__name__": module, "register": register, "environment": environment, "how": how}
        )

    run("notebook", base, disturbances={"lag": Delay(3)})
    with pytest.raises(UserError, match="cannot be called"):
        run("notebook", base, disturbances={"a+b": Delay()})
    assert make("robot", "lag").default_params.observation == Delay(3), (
        "what failed replaced nothing"
    )
    run("notebook", base, disturbances={"lag": Delay(5)})
    assert make("robot", "lag").default_params.observation == Delay(5)
    run("notebook", lambda disturbance: disturbance)
    assert make("robot", "wind") == "wind"
    with pytest.raises(UserError, match="registered by notebook; .* replace=True"):
        run("library", base)
    run("library", base, replace=True)
    assert make("robot").base is base
    with pytest.raises(UserError, match="registered by library"):
        run("notebook", base)


def test_of_equal_environments_the_one_with_the_nearest_parameters_is_meant(monkeypatch):
    monkeypatch.setattr(registry, "_entries", dict(registry._entries))
    built_in = registry.description_of(make("rover"), "rover").ceiling

    def own(env, episodes, seed):
        return Ceiling(7.0)

    fast = Rover(RoverParams(target_speed=0.8))
    slips = {"ar1-slip": ("slip", Ar1Slip())}
    register("my-rover", fast, slips, ceiling=own, with_params=Rover)
    for made, ceiling in (
        (make("my-rover"), own),
        (make("my-rover", "ar1-slip"), own),
        (make("my-rover", "dropout"), own),
        (make("rover"), built_in),
        (make("rover", "ar1-slip"), built_in),
        (make("rover", "delay"), built_in),
    ):
        assert registry.description_of(made).ceiling is ceiling
    # Another id of the same environment and parameters does not change what the first one means.
    register("plain-rover", Rover(), ceiling=own)
    assert registry.description_of(make("rover")).ceiling is built_in
    assert registry.description_of(make("rover"), "plain-rover").ceiling is own


@pytest.mark.parametrize(
    ("given", "match"),
    [
        (make("pendulum"), "this Pendulum-v1 is an environment already: use rtd.disturb"),
        (make("rover"), "this rover is an environment already: use rtd.disturb"),
        (5, "a string such as 'rover', not 5"),
        (["rover"], "a string such as 'rover', not"),
        (Rover, "a string such as 'rover', not"),
    ],
)
def test_what_is_no_name_is_one_line(given, match):
    with pytest.raises(UserError, match=match) as caught:
        make(given)
    assert "\n" not in str(caught.value)


def test_a_new_registration_keeps_nothing_of_the_one_that_it_replaces(monkeypatch):
    monkeypatch.setattr(registry, "_entries", dict(registry._entries))
    base = make("PointRobot-misc")
    wrong = {"stand": lambda env: [0.0, 0.0]}
    register("robot", base, baselines=wrong, ceiling=lambda env, episodes, seed: 0.0)
    register("alias", base)  # another name of it has what is known
    assert registry.description_of(base, "alias").baselines == wrong
    del registry._entries["alias"]
    register("robot", base)
    found = registry.description_of(base, "robot")
    assert found.baselines == {} and found.ceiling is None


def test_nearest_says_nothing_without_a_likeness():
    assert nearest("sigm", ["sigma"]) == "; did you mean 'sigma'?"
    assert nearest("xyz", ["sigma"]) == ""


class Unlimited(environment.Environment):
    """Its parameters do not state its time limit."""

    default_params = None

    def reset_env(self, key, params):
        return jnp.zeros(3), jnp.int32(0)

    def step_env(self, key, state, action, params):
        return jnp.zeros(3), state + jnp.int32(1), jnp.sum(action), jnp.array(False), {}

    def is_truncated(self, state, params):
        return state >= 5

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (1,))


def test_processes_that_begin_later_need_to_know_the_time_limit():
    for process in (Pulses(elements=(0,)), Chain((GaussianNoise(), Sine()))):
        with pytest.warns(UserWarning, match="begin at any of 10,000 steps"):
            disturb(Unlimited(), process)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        disturb(Unlimited(), GaussianNoise())
        disturb(make("pendulum"), Sine())


def test_what_cannot_be_disturbed_is_not_registered():
    with pytest.raises(UserError, match="is disturbed already"):
        register("noisy-pendulum", make("pendulum", "noise"))
    register("heavy-pendulum", make("pendulum", m=2.0), replace=True)

    class Bare:
        default_params = None

        def reset(self, key, params=None):
            return jnp.zeros(3), jnp.int32(0)

        def step(self, key, state, action, params=None):
            return jnp.zeros(3), state, 0.0, False, False, {"final_observation": jnp.zeros(3)}

        action_space = Unlimited.action_space

    with pytest.raises(UserError, match="Bare has no reset_env"):
        register("bare-plant", Bare())
    assert "bare-plant" not in registry._entries


def test_a_parameter_that_is_an_array_is_not_denied():
    @struct.dataclass
    class Params:
        mass: float = np.float32(1.0)
        max_steps_in_episode: int = 5

    class Heavy(Unlimited):
        default_params = Params()

    register("heavy-plant", Heavy(), replace=True)
    with pytest.raises(UserError, match="'mass' is no plain number .* cannot be set by name"):
        make("heavy-plant", mass=2.0)
    with pytest.raises(UserError, match="has no parameter 'mess'"):
        make("heavy-plant", mess=2.0)


def test_parameters_of_the_plant_inside_are_refused():
    env = make("pendulum", "noise")
    with pytest.raises(UserError, match=r"pass params=env\.default_params\.replace"):
        parameters_of(env, env.default_params.env)

    @dataclasses.dataclass
    class Plain:
        gain: float = 1.0

    with pytest.raises(UserError, match=r"decorate it with flax\.struct\.dataclass"):
        parameters_of(Unlimited(), Plain())
