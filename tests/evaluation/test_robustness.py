"""Tests tables of robustness against separate evaluations in separately made environments."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from random_policies import random_policy

import rtd3jax as rtd
from rtd3jax.envs.rover import Rover
from rtd3jax.envs.rover.slip import ConstantSlip
from rtd3jax.evaluation.returns import _episode_returns
from rtd3jax.evaluation.robustness import make_cases, stresses_of

EPISODES, SEED, STEPS = 3, 7, 12


def rover(disturbance="ar1-slip", **parameters):
    return rtd.make("rover", disturbance, max_steps_in_episode=STEPS, **parameters)


@pytest.fixture(scope="module")
def policy():
    """A controller whose return every stress changes; small, so that it compiles fast."""
    return rtd.pid_policy(rover(), kp=0.1, ki=0.5, feedforward=(0.5, 0.0), ignored=1)


def table(policies, env, stresses):
    return rtd.robustness(policies, env, stresses, EPISODES, SEED)


def test_every_stress_equals_an_environment_that_was_made_with_it(policy):
    def slipping(slip):
        return Rover(rover().default_params.replace(slip=ConstantSlip(slip)))

    separate = {
        # Delays draw nothing. In a plant without random numbers, the wrapped environment's
        # episodes are therefore those of the test.
        "delay": ("none", lambda k: rover("delay", steps=int(k))),
        "action-delay": ("none", lambda k: rover("action-delay", steps=int(k))),
        "slip": ("ar1-slip", slipping),
        "slip-bound": ("ar1-slip", lambda bound: rover(max_slip=bound)),
        "wheelbase-factor": ("ar1-slip", lambda factor: rover(wheelbase=0.5 * factor)),
    }
    for name, (disturbance, make) in separate.items():
        tested = rover(disturbance)
        values = next(s.values for s in stresses_of(tested) if s.name == name)[::6]
        rows = table(policy, tested, [f"{name}={','.join(map(str, values))}"])
        expected = [np.mean(rtd.evaluate(policy, make(v), EPISODES, SEED)) for v in values]
        np.testing.assert_allclose(rows["return"], expected, rtol=2e-5, atol=1e-6)
        assert rows["value"].tolist() == list(values) and rows["return"].nunique() == len(values)


@pytest.mark.parametrize("disturbance", ["ar1-slip", "ar1-slip+dropout+action-delay"])
def test_without_strength_the_episodes_are_those_of_the_plain_evaluation(policy, disturbance):
    env = rover(disturbance)
    idle = ["noise=0", "dropout=0", "delay=0", "action-delay=0", "max_speed-factor=1"]
    plain = np.asarray(rtd.evaluate(policy, env, EPISODES, SEED), np.float64)
    rows = table(policy, env, idle)
    np.testing.assert_allclose(rows["return"], plain.mean(), rtol=1e-6)
    np.testing.assert_allclose(rows["standard_error"], plain.std(ddof=1) / EPISODES**0.5, rtol=1e-4)
    assert rows["stress"].tolist() == [item.partition("=")[0] for item in idle]
    assert (rows["episodes"] == EPISODES).all()


def slow_return(policy, env, key, sigma=0.0, p=0.0):
    """One episode in a plain loop; noise and lost readings act on what the policy reads."""
    policy_key, reset_key, step_key = jax.random.split(key, 3)
    own = jax.random.split(policy_key, 1)[0]
    observation, state = env.reset(jax.random.split(reset_key, 1)[0])
    memory, held, total = policy.init(own), jnp.zeros(2), 0.0
    for time in range(env.default_params.max_steps_in_episode):
        stream = jax.random.fold_in(jax.random.fold_in(own, time), 0x6F627300)
        noisy = observation + jnp.float32(sigma) * jax.random.normal(stream, (2,))
        held = jnp.where(jax.random.uniform(stream) < p, held, noisy)
        action, memory = policy.step(memory, held)
        key = jax.random.split(jax.random.fold_in(step_key, time), 1)[0]
        observation, state, reward, *_ = env.step(key, state, action)
        total += float(reward)
    return total


def test_noise_and_lost_readings_equal_a_plain_loop(policy):
    env = rtd.make("rover", "ar1-slip", max_steps_in_episode=5)
    rows = rtd.robustness(policy, env, ["noise=0.3", "dropout=0.5"], episodes=1, seed=SEED)
    strengths = {"sigma": 0.3}, {"p": 0.5}
    slow = [slow_return(policy, env, jax.random.key(SEED), **how) for how in strengths]
    np.testing.assert_allclose(rows["return"], slow, rtol=1e-4)
    assert rows["standard_error"].isna().all()


def test_one_program_serves_all_values_of_all_stresses_of_signals_and_factors(policy):
    env = rover()
    before = _episode_returns._cache_size()
    two = {"a": policy, "b": policy.replace(ki=2 * policy.ki)}
    rows = rtd.robustness(two, env, ["noise", "delay", "dropout", "wheelbase-factor"], 2)
    assert _episode_returns._cache_size() == before + 1
    assert len(rows) == 2 * (7 + 7 + 6 + 7) and set(rows["policy"]) == {"a", "b"}


def test_policies_meet_the_same_episodes_and_the_true_state_is_rewarded():
    env = rtd.make("pendulum", "noise", max_steps_in_episode=STEPS)
    policy = rtd.random_policy(env)
    rows = table({"random": policy, "again": policy}, env, ["noise=1", "m-factor=2"])
    first, again = (rows[rows["policy"] == name] for name in ("random", "again"))
    assert first["return"].tolist() == again["return"].tolist()
    # The environment computes the reward from the observation that it made; the added noise does
    # not act on a random policy.
    plain = np.mean(rtd.evaluate(policy, env, EPISODES, SEED))
    true = np.mean(rtd.evaluate(policy, env, EPISODES, SEED, true_reward=True))
    noisy = first.iloc[0]
    np.testing.assert_allclose([noisy["return"], noisy["true_return"]], [plain, true], rtol=1e-5)
    assert abs(plain - true) > 0.1


def test_the_picture_has_a_line_for_each_policy():
    names = ["td3", "lstm-td3, history 3", "lstm-td3, history 10", "pid", "lstm-td3x"]
    chance = np.random.default_rng(0)
    rows = pd.DataFrame(
        [
            dict(policy=name, stress=stress, quantity=f"strength of {stress}", value=value)
            | {"return": chance.normal(), "standard_error": 0.1}
            for name in names
            for stress in ("noise", "slip")
            for value in (2.0, 0.0, 1.0)
        ]
    )
    panels = rtd.plot_robustness(rows, title="rover").axes
    assert [axes.get_xlabel() for axes in panels] == ["strength of noise", "strength of slip"]
    lines = {line.get_label(): line for line in panels[1].get_lines()}
    assert list(lines) == names
    assert lines["td3"].get_color() == "#000000"
    assert lines["lstm-td3, history 3"].get_color() == "#0072B2"
    assert lines["lstm-td3x"].get_color() not in ("#000000", "#0072B2")
    assert len({(line.get_color(), line.get_linestyle()) for line in lines.values()}) == 5
    own = rows[(rows["policy"] == "pid") & (rows["stress"] == "slip")].sort_values("value")
    np.testing.assert_array_equal(lines["pid"].get_ydata(), own["return"])


def test_a_registration_brings_its_own_stresses(policy):
    def push(params, strength):
        return "action", rtd.OrnsteinUhlenbeck(sigma=0.0, mean=float(strength))

    def other_plant(params, target):
        return Rover(params.replace(target_speed=float(target)))

    push = rtd.Stress("push", (0, 0.1), push, "push in m/s")
    target = rtd.Stress("target", (0.5, 0.6), other_plant)
    rtd.register("a-rover", Rover(), positive=("wheelbase",), stresses=(push, target))
    assert [stress.name for stress in stresses_of(rover(), "a-rover")][4:] == [
        "push",
        "target",
        "wheelbase-factor",
    ]
    rows = table(policy, rover("none"), [push, target])
    shifted = rtd.disturb(rover("none"), rtd.OrnsteinUhlenbeck(sigma=0.0, mean=0.1), "action")
    expected = [
        np.mean(rtd.evaluate(policy, env, EPISODES, SEED))
        for env in (rover("none"), shifted, rover("none"), rover("none", target_speed=0.6))
    ]
    np.testing.assert_allclose(rows["return"], expected, rtol=1e-5)
    assert rows["quantity"].tolist() == ["push in m/s"] * 2 + ["target"] * 2
    # The own disturbance of the tested environment acts on another plant, too.
    rows = table(policy, rover("action-delay", steps=3), [target])
    expected = [
        np.mean(rtd.evaluate(policy, rover("action-delay", steps=3, **plant), EPISODES, SEED))
        for plant in ({}, {"target_speed": 0.6})
    ]
    np.testing.assert_allclose(rows["return"], expected, rtol=1e-5)
    with pytest.raises(rtd.UserError, match="two stresses are called 'delay'; rename"):
        rtd.register("b-rover", Rover(), stresses=[dataclasses.replace(push, name="delay")])
    with pytest.raises(rtd.UserError, match=r"stresses must be rtd\.Stress, not 'push'"):
        rtd.register("b-rover", Rover(), stresses=["push"])


@pytest.mark.parametrize(
    "stresses, message",
    [
        (["dealy"], "unknown stress 'dealy' of rover; did you mean 'delay'"),
        (["noise=loud"], "stress 'noise=loud': write values as noise=0,0.5,1"),
        (["noise=-1"], "stress noise=-1: GaussianNoise: sigma=-1.0 must be at least 0"),
        (["dropout=1.5"], "stress dropout=1.5: Dropout: p=1.5 must be at most 1"),
        (["delay=1.5"], "stress delay=1.5: a delay of 1.5 steps must be a whole number"),
        (["delay=-1"], "stress delay=-1: VariableDelay: steps=-1 must be at least 0"),
        (["slip=1.2"], "stress slip=1.2: ConstantSlip: slip=1.2 must be at most 1"),
        (["wheelbase-factor=0"], "wheelbase-factor=0 must be greater than 0"),
        (["noise=nan"], "must be a tuple of finite numbers"),
        (["noise", "noise=3"], "stress noise is given twice"),
        ([], "needs at least one stress"),
        ([rtd.Stress("x", (1,), lambda params, v: 3)], "change returned int; it must return"),
        ([rtd.Stress("x", (1,), lambda params, v: 1 / 0)], "stress x=1 failed: division by zero"),
        ([rtd.Stress("x", (1,), lambda params, v: rtd.Hidden(0))], "Hidden changes the number"),
        ([rtd.Stress("x", (1,), lambda params, v: rtd.make("pendulum"))], "other sizes"),
        ([rtd.Stress("x", (1,), lambda params, v: ("reward", rtd.Dropout()))], "channel 'reward'"),
    ],
)
def test_mistakes_are_named_in_one_line(policy, stresses, message):
    with pytest.raises(rtd.UserError) as caught:
        rtd.robustness(policy, rover(), stresses, 2)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_unsuitable_policies_and_stresses_are_refused(policy):
    pendulum = rtd.make("pendulum")
    with pytest.raises(rtd.UserError, match="policy 'td3': the policy expects 3 observation"):
        rtd.robustness({"td3": random_policy("td3", pendulum)}, rover())
    with pytest.raises(rtd.UserError, match="at least one policy"):
        rtd.robustness({}, rover())
    with pytest.raises(rtd.UserError, match="episodes must be"):
        rtd.robustness(policy, rover(), episodes=0)
    with pytest.raises(rtd.UserError, match="a stress cannot be called 'my stress'"):
        rtd.Stress("my stress", (1,), lambda params, v: params)
    with pytest.raises(rtd.UserError, match="change must be a function"):
        rtd.Stress("x", (1,), 3)
    with pytest.raises(rtd.UserError, match="this one lacks policy"):
        rtd.plot_robustness(table(policy, rover(), ["delay=0"]).drop(columns="policy"))


def test_delays_beyond_the_shortest_queue_are_exact(policy):
    lengths = [
        case.observation.delay.longest for case in make_cases(rover(), ["delay=0,8,9,16,17"])
    ]
    assert lengths == [8, 8, 16, 16, 32]
    row = table(policy, rover("none"), ["delay=9"])
    expected = np.mean(rtd.evaluate(policy, rover("delay", steps=9), EPISODES, SEED))
    np.testing.assert_allclose(row["return"], expected, rtol=1e-5)
