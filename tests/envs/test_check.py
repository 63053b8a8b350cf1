"""Tests every finding with an environment that has one error; correct environments pass."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces

from rtd3jax.envs.builtin import DISTURBANCES, ENVIRONMENTS
from rtd3jax.envs.check import Finding, _equal, check_env, find_problems
from rtd3jax.envs.registry import make
from rtd3jax.errors import UserError


@struct.dataclass
class State:
    time: jax.Array
    position: jax.Array


class Good(environment.Environment):
    """A point that is pushed about; eight steps. The classes below break one thing each."""

    @property
    def default_params(self):
        return environment.EnvParams(max_steps_in_episode=8)

    def reset_env(self, key, params):
        position = jax.random.uniform(key, (), jnp.float32, -0.5, 0.5)
        return position[None], State(jnp.int32(0), position)

    def step_env(self, key, state, action, params):
        position = state.position + 0.1 * action[0]
        state = State(state.time + jnp.int32(1), position)
        return position[None], state, -(position**2), jnp.array(False), {}

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (1,))

    def observation_space(self, params):
        return spaces.Box(-jnp.inf, jnp.inf, (1,))


class HalfPrecision(Good):
    def reset(self, key, params=None):
        observation, state = super().reset(key, params)
        return observation.astype(jnp.bfloat16), state


class WiderState(Good):
    def reset_env(self, key, params):
        observation, state = super().reset_env(key, params)
        return observation, state.replace(time=jnp.float32(0))

    def step(self, key, state, action, params=None):
        after, reset = self.step_env(key, state, action, params), jnp.array(False)
        done = after[1].time >= 8
        state = State(after[1].time.astype(jnp.int32), after[1].position)
        return after[0], state, after[2], reset, done, {"final_observation": after[0]}


class OtherState(Good):
    def step(self, key, state, action, params=None):
        observation, state, *rest = super().step(key, state, action, params)
        return observation, (state,), *rest


class OtherSpace(Good):
    def observation_space(self, params):
        return spaces.Box(-1.0, 1.0, (3,))


class Callback(Good):
    def step_env(self, key, state, action, params):
        observation, *rest = super().step_env(key, state, action, params)
        shape = jax.ShapeDtypeStruct((1,), jnp.float32)
        return jax.pure_callback(lambda x: np.asarray(x), shape, observation), *rest


class NotFinite(Good):
    def step_env(self, key, state, action, params):
        observation, state, _, terminated, info = super().step_env(key, state, action, params)
        return observation, state, jnp.log(4.0 - state.time), terminated, info


class NotFiniteAtReset(Good):
    def reset_env(self, key, params):
        observation, state = super().reset_env(key, params)
        return observation / 0.0, state


class Counting(Good):
    """Keeps its own count of the calls, which a compiled program freezes."""

    calls = 0

    def step_env(self, key, state, action, params):
        self.calls += 1
        observation, *rest = super().step_env(key, state, action, params)
        return observation + self.calls, *rest


class NumpyRandom(Good):
    def reset_env(self, key, params):
        position = jnp.float32(np.random.default_rng().uniform())
        return position[None], State(jnp.int32(0), position)


class HostRandom(Good):
    """A callback that gives another number at every call."""

    def step_env(self, key, state, action, params):
        observation, *rest = super().step_env(key, state, action, params)
        shape = jax.ShapeDtypeStruct((1,), jnp.float32)
        noise = jax.pure_callback(
            lambda x: np.random.default_rng().normal(size=x.shape).astype(np.float32),
            shape,
            observation,
            vmap_method="expand_dims",
        )
        return observation + noise, *rest


class TimeLimitTerminates(Good):
    def step_env(self, key, state, action, params):
        observation, state, reward, _, info = super().step_env(key, state, action, params)
        return observation, state, reward, state.time >= params.max_steps_in_episode, info


class EarlierLimitTerminates(TimeLimitTerminates):
    """It ends its episodes before the limit of its parameters."""

    @property
    def default_params(self):
        return environment.EnvParams(max_steps_in_episode=50)

    def step_env(self, key, state, action, params):
        return super().step_env(key, state, action, params.replace(max_steps_in_episode=5))


class NamelessLimitTerminates(Good):
    """Its limit is its own, and no parameter names it."""

    @property
    def default_params(self):
        return ()

    def step_env(self, key, state, action, params):
        observation, state, reward, _, info = super().step_env(key, state, action, params)
        return observation, state, reward, state.time >= 5, info

    def is_truncated(self, state, params):
        return jnp.array(False)


class Endless(Good):
    def is_truncated(self, state, params):
        return jnp.array(False)


class NextObservation(Good):
    def step(self, key, state, action, params=None):
        observation, *rest, info = super().step(key, state, action, params)
        return observation, *rest, {**info, "final_observation": observation}


class OldObservation(Good):
    def step(self, key, state, action, params=None):
        *rest, info = super().step(key, state, action, params)
        return *rest, {**info, "final_observation": state.position[None]}


@struct.dataclass
class HiddenState(State):
    bias: jax.Array


class HiddenLeaks(Good):
    """A wrapper's own reset, which forgets the hidden bias."""

    def reset_env(self, key, params):
        observation, state = super().reset_env(key, params)
        bias = jax.random.normal(jax.random.fold_in(key, 1), ())
        return observation + bias, HiddenState(state.time, state.position, bias)

    def step_env(self, key, state, action, params):
        observation, new, reward, terminated, info = super().step_env(key, state, action, params)
        state = HiddenState(new.time, new.position, state.bias)
        return observation + state.bias, state, reward, terminated, info

    def step(self, key, state, action, params=None):
        bias = state.bias
        observation, state, *rest, info = super().step(key, state, action, params)
        done = rest[1] | rest[2]
        observation = jnp.where(done, observation - state.bias + bias, observation)
        return observation, state.replace(bias=bias), *rest, info


class Unbounded(Good):
    def action_space(self, params):
        return spaces.Box(-jnp.inf, jnp.inf, (1,))


class VectorReward(Good):
    def step_env(self, key, state, action, params):
        observation, state, reward, terminated, info = super().step_env(key, state, action, params)
        return observation, state, reward[None], terminated, info


class NoFinalObservation(Good):
    def step(self, key, state, action, params=None):
        *rest, _ = super().step(key, state, action, params)
        return *rest, {}


BROKEN = [
    (HalfPrecision, "dtype", "observation is bfloat16"),
    (WiderState, "dtype", r"state.time is float32\[\] after reset and int32\[\] after step"),
    (OtherState, "dtype", "of different structure"),
    (OtherSpace, "space", r"shape \(3,\), but the observation has \(1,\)"),
    (Callback, "vmap", "vmap_method"),
    (NotFinite, "finite", "reward of step 3 is not finite"),
    (NotFiniteAtReset, "finite", "observation of reset"),
    (Counting, "pure", "step gives different results"),
    (NumpyRandom, "pure", "reset gives different results"),
    (HostRandom, "pure", "step gives different results"),
    (TimeLimitTerminates, "time-limit", "all 8 episodes terminate at step 8"),
    (NamelessLimitTerminates, "time-limit", "all 8 episodes terminate at step 5"),
    (EarlierLimitTerminates, "time-limit", "all 8 episodes terminate at step 5"),
    (Endless, "time-limit", "continues after params.max_steps_in_episode = 8"),
    (NextObservation, "final-observation", "next episode's first observation"),
    (OldObservation, "final-observation", "during an episode"),
    (HiddenLeaks, "leak", "depends on the previous one"),
    (Unbounded, "interface", "unbounded; give its Box finite low and high"),
    (VectorReward, "interface", "reward must be a scalar"),
    (NoFinalObservation, "interface", "info lacks 'final_observation'"),
]


@pytest.mark.parametrize(
    ("broken", "kind", "match"), BROKEN, ids=lambda x: getattr(x, "__name__", "")
)
def test_what_is_broken_is_found_and_nothing_else(broken, kind, match):
    (finding,) = find_problems(broken())
    assert finding.kind == kind
    assert finding.remedy or kind == "interface", "whose messages have the remedy"
    assert re.search(match, str(finding))


@pytest.mark.parametrize(
    ("broken", "match"),
    [
        (TimeLimitTerminates, "all 8 episodes terminate at step 8"),
        (Unbounded, "unbounded; give its Box finite low and high"),
    ],
)
def test_an_error_is_one_line_with_the_remedy(broken, match):
    with pytest.raises(UserError, match=match) as caught:
        check_env(broken())
    message = str(caught.value)
    assert "\n" not in message and message.startswith(f"environment {broken.__name__}: ")
    assert ";" in message, "a remedy"


def test_every_kind_of_finding_has_a_broken_environment():
    kinds = {"interface", "dtype", "space", "vmap", "finite", "pure", "leak", "final-observation"}
    assert {kind for _, kind, _ in BROKEN} == kinds | {"time-limit"}


def test_a_finding_ends_with_its_remedy():
    assert str(Finding("pure", "this", "that")) == "this; that"


def test_several_problems_are_listed_together():
    class Poor(NotFinite, NextObservation):
        pass

    with pytest.raises(UserError, match="environment Poor has 2 problems:\n  1. the reward") as e:
        check_env(Poor())
    assert "\n  2. info['final_observation']" in str(e.value)

    class Bad(VectorReward, NoFinalObservation):
        pass

    with pytest.raises(UserError, match="has 2 problems"):
        check_env(Bad())


@pytest.mark.parametrize(
    ("env_id", "disturbance"),
    [
        ("rover", "ar1-slip+dropout"),
        ("MountainCarContinuous-v0", "none"),
    ],
)
def test_sound_environments_pass(env_id, disturbance):
    check_env(make(env_id, disturbance, max_steps_in_episode=20))


@pytest.mark.parametrize("disturbance", ["noise", "damped-sine"])
def test_what_xla_computes_twice_is_no_finding(disturbance):
    check_env(make("pendulum", disturbance, max_steps_in_episode=12))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env_id", "disturbance"), [(e, d) for e in ENVIRONMENTS for d in DISTURBANCES[e]]
)
def test_every_environment_of_ours_passes(env_id, disturbance):
    check_env(make(env_id, disturbance, max_steps_in_episode=12))


def test_a_time_limit_of_one_step_is_a_warning(recwarn):
    class Once(Good):
        default_params = environment.EnvParams(max_steps_in_episode=1)

    class Bandit(TimeLimitTerminates):
        default_params = environment.EnvParams(max_steps_in_episode=1)

    check_env(Once())
    (warning,) = [w for w in recwarn if w.category is UserWarning]
    assert "environment Once: a time limit ends all 8 episodes at their first step; " in str(
        warning.message
    )
    assert find_problems(Once()) == []
    recwarn.clear()
    check_env(Bandit())  # nothing follows its end, and no value is bootstrapped
    check_env(Good())
    assert not [w for w in recwarn if w.category is UserWarning]


def test_scales_that_will_hurt_are_a_warning(recwarn):
    class Scaled(Good):
        def reset_env(self, key, params):
            observation, state = super().reset_env(key, params)
            return observation * jnp.array([1.0, 1e4, 1e-4, 0.0]), state

        def step_env(self, key, state, action, params):
            observation, state, reward, *rest = super().step_env(key, state, action, params)
            return observation * jnp.array([1.0, 1e4, 1e-4, 0.0]), state, 1e-3 * reward, *rest

        def observation_space(self, params):
            return spaces.Box(-jnp.inf, jnp.inf, (4,))

    check_env(Scaled())
    seen, rewards = [str(w.message) for w in recwarn if w.category is UserWarning]
    assert re.search(r"far from one: element 1 \de\+03, element 2 \de-05; train", seen)
    assert re.search(
        r"rewards of 0.000\d are far from one; train with reward_scale=\de\+03", rewards
    )
    recwarn.clear()
    check_env(Good())
    check_env(make("pendulum", "none", max_steps_in_episode=12))
    assert not [w for w in recwarn if w.category is UserWarning]


def test_nan_equals_nan():
    """An environment of NaN is not finite, and nothing else."""

    class Nowhere(Good):
        def step_env(self, key, state, action, params):
            observation, *rest = super().step_env(key, state, action, params)
            return observation * jnp.nan, *rest

    assert {finding.kind for finding in find_problems(Nowhere())} == {"finite"}


def test_the_tolerance_is_relative_to_the_array_and_not_for_whole_numbers():
    large, near = jnp.array([1e4, 1.0]), jnp.array([1e4, 1.05])
    assert _equal((large,), (near,)) and not _equal((large[1],), (near[1],))
    assert not _equal((1e-6 * large,), (1e-6 * large + 1e-6,))
    assert not _equal((jnp.int32(10**8),), (jnp.int32(10**8 + 1),))
    assert _equal((jnp.array([jnp.nan, 1.0]),), (jnp.array([jnp.nan, 1.0]),))
    assert not _equal((jax.random.key(0),), (jax.random.key(1),))


def test_a_termination_of_its_own_is_not_a_time_limit():
    class Falls(Good):
        def step_env(self, key, state, action, params):
            observation, state, reward, _, info = super().step_env(key, state, action, params)
            return observation, state, reward, jnp.abs(observation[0]) > 0.6, info

    check_env(Falls())


def test_no_environment_at_all():
    with pytest.raises(UserError, match="no method reset"):
        check_env(object())


def test_actions_of_whole_numbers_are_a_warning(recwarn):
    class Gears(Good):
        def action_space(self, params):
            return spaces.Box(-3, 3, (1,), jnp.int32)

    check_env(Gears())
    (warning,) = [str(w.message) for w in recwarn if w.category is UserWarning]
    assert "action_space is a Box of int32" in warning and "round the action" in warning


@pytest.mark.parametrize("seed", [2**31, 2**32 - 1])
def test_every_seed_is_possible(seed):
    assert find_problems(Good(), seed=seed) == []


@pytest.mark.parametrize("seed", [2**32, -1, 0.5, True, "0"])
def test_an_impossible_seed_is_not_a_problem_of_the_environment(seed):
    for check in (check_env, find_problems):
        with pytest.raises(UserError, match="^seed must be an integer of at least 0"):
            check(Good(), seed=seed)
