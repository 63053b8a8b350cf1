"""Tests the adapter with a small environment with Brax's interface, and MuJoCo Playground."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import rtd3jax as rtd
from rtd3jax.envs.interface import foreign_code
from rtd3jax.errors import UserError


@struct.dataclass
class State:
    """Brax's names; MuJoCo Playground says ``data`` for ``pipeline_state``."""

    pipeline_state: Any
    obs: Any
    reward: jax.Array
    done: jax.Array
    metrics: dict
    info: dict


class Cart:
    """A cart that is pushed; beyond 1 m it is done. Observations are position and velocity."""

    action_size = 1

    def reset(self, rng):
        rng, key = jax.random.split(rng)
        physics = jnp.concatenate(
            [jax.random.uniform(key, (1,), minval=-0.1, maxval=0.1), jnp.zeros(1)]
        )
        zero = jnp.zeros(())
        return State(physics, self.see(physics), zero, zero, {"speed": zero}, {"rng": rng, "n": 0})

    def step(self, state, action):
        rng, key = jax.random.split(state.info["rng"])
        velocity = state.pipeline_state[1] + 0.1 * action[0] + 0.001 * jax.random.normal(key)
        physics = jnp.stack([state.pipeline_state[0] + 0.1 * velocity, velocity])
        return state.replace(
            pipeline_state=physics,
            obs=self.see(physics),
            reward=-jnp.abs(physics[0]),
            done=jnp.abs(physics[0]) > 1.0,  # a bool, where reset gave a float
            metrics={"speed": jnp.abs(velocity)},
            info={**state.info, "rng": rng, "n": state.info["n"] + 1},
        )

    def see(self, physics):
        return physics


class Timed(Cart):
    """As under Brax's EpisodeWrapper with a length of three."""

    def reset(self, rng):
        state = super().reset(rng)
        return state.replace(info={**state.info, "truncation": jnp.zeros(())})

    def step(self, state, action):
        truncation = state.info["truncation"]
        state = super().step(state, action)
        over = state.info["n"] >= 3
        truncation = jnp.where(over, 1.0 - state.done, truncation)
        done = jnp.where(over, 1.0, state.done)
        return state.replace(done=done, info={**state.info, "truncation": truncation})


class Several(Cart):
    def see(self, physics):
        return {"state": physics[:1], "privileged_state": physics}


def play(env, action, steps, seed=0):
    """The last four values of every step, and the observations after it."""
    step = jax.jit(env.step)
    observation, state = env.reset(jax.random.key(seed))
    rows = []
    for index in range(steps):
        after, state, reward, terminated, truncated, info = step(
            jax.random.key(index), state, jnp.full(env.brax.action_size, action)
        )
        rows.append((after, float(reward), bool(terminated), bool(truncated), info))
    return observation, rows


def test_check_env_is_content():
    rtd.check_env(rtd.from_brax(Timed(), max_steps_in_episode=12))


def test_it_goes_as_the_environment_goes():
    env, brax = rtd.from_brax(Cart()), Cart()
    first, rows = play(env, 0.5, 4)
    state = brax.reset(jax.random.key_data(jax.random.key(0)))
    np.testing.assert_allclose(first, state.obs, rtol=1e-6)
    for after, reward, terminated, truncated, info in rows:
        state = brax.step(state, jnp.array([0.5]))
        np.testing.assert_allclose(after, state.obs, rtol=1e-5)
        assert reward == pytest.approx(float(state.reward), rel=1e-5)
        assert not terminated and not truncated
        np.testing.assert_allclose(info["metrics"]["speed"], state.metrics["speed"], rtol=1e-5)


def test_done_is_a_termination_and_the_final_observation_that_of_the_end():
    _, rows = play(rtd.from_brax(Cart()), 1.0, 20)
    (end,) = [index for index, row in enumerate(rows) if row[2]]
    after, _, _, truncated, info = rows[end]
    assert not truncated
    assert info["final_observation"][0] > 1.0 > abs(after[0])
    assert abs(after[0]) <= 0.1 and after[1] == 0.0, "a start anew"


def test_the_limit_is_a_truncation():
    _, rows = play(rtd.from_brax(Cart(), max_steps_in_episode=3), 0.0, 7)
    assert [(row[2], row[3]) for row in rows] == [(False, t % 3 == 2) for t in range(7)]


def test_an_episode_wrappers_limit_is_a_truncation_too():
    _, rows = play(rtd.from_brax(Timed()), 0.0, 7)
    assert [(row[2], row[3]) for row in rows] == [(False, t % 3 == 2) for t in range(7)]
    starts = [float(rows[t][0][0]) for t in (2, 5)]
    assert starts[0] != starts[1], "each reset draws anew"


def test_velocities_can_be_hidden_and_observations_chosen():
    env = rtd.from_brax(Cart(), keep=[0])
    observation, rows = play(env, 1.0, 1)
    assert observation.shape == rows[0][0].shape == env.observation_space().shape == (1,)
    assert rtd.from_brax(Several()).observation_space().shape == (1,)
    privileged = rtd.from_brax(Several(), observation_key="privileged_state")
    assert play(privileged, 1.0, 1)[0].shape == (2,)


def test_it_is_disturbed_and_evaluated_as_any_other():
    env = rtd.disturb(rtd.from_brax(Cart(), keep=[0], max_steps_in_episode=5), rtd.Dropout(p=0.2))
    returns = rtd.evaluate(rtd.random_policy(env), env, episodes=8)
    assert returns.shape == (8,) and np.isfinite(returns).all() and np.unique(returns).size == 8


class NoState(Cart):
    def reset(self, rng):
        return jnp.zeros(3)


class AutoReset(Cart):
    def reset(self, rng):
        state = super().reset(rng)
        return state.replace(info={**state.info, "first_obs": state.obs})


class Batch(Cart):
    def reset(self, rng):
        return jax.vmap(super().reset)(jax.random.split(rng, 4))


class Failing(Cart):
    def reset(self, rng):
        raise RuntimeError("no model\nhere")


@pytest.mark.parametrize(
    ("env", "options", "match"),
    [
        (object(), {}, "no reset"),
        (NoState(), {}, "has no obs, reward"),
        (AutoReset(), {}, "AutoResetWrapper"),
        (Batch(), {}, "VmapWrapper"),
        (Failing(), {}, "failed in reset: RuntimeError: no model"),
        (Cart(), {"keep": [2]}, "keep=2 is not in Cart's observation of size 2"),
        (Cart(), {"keep": []}, "at least one"),
        (Cart(), {"keep": [-1]}, "not negative"),
        (Cart(), {"keep": slice(2, 2)}, "at least one"),
        (Cart(), {"keep": ["x"]}, "must be a list of indices, or a slice"),
        (Cart(), {"observation_key": "state"}, "leave out observation_key"),
        (Several(), {"observation_key": "pixels"}, "it has privileged_state, state"),
        (Cart(), {"max_steps_in_episode": 0}, "max_steps_in_episode"),
    ],
)
def test_misfits_are_named(env, options, match):
    with pytest.raises(UserError, match=match) as caught:
        rtd.from_brax(env, **options)
    assert "\n" not in str(caught.value)


def test_a_name_without_the_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mujoco_playground", None)
    with pytest.raises(UserError, match=r"pip install 'rtd3jax\[playground\]'"):
        rtd.from_brax("CheetahRun")


def test_a_cheetah_without_velocities_runs():
    """A locomotion task of MuJoCo Playground; nine positions, of which eight are seen."""
    pytest.importorskip("mujoco_playground")
    with pytest.raises(UserError, match="did you mean 'CheetahRun'"):
        rtd.from_brax("CheetahRum")
    env = rtd.from_brax("CheetahRun", keep=range(8), max_steps_in_episode=2)
    _, rows = play(env, 0.5, 3)
    assert [(row[2], row[3]) for row in rows] == [(False, False), (False, True), (False, False)]
    with foreign_code():
        state = jax.jit(env.brax.reset)(jax.random.key_data(jax.random.key(0)))
    step = jax.jit(env.brax.step)
    for _, reward, _, _, info in rows[:2]:
        with foreign_code():
            state = step(state, jnp.full(6, 0.5))
        assert state.obs.shape == (17,)
        np.testing.assert_allclose(info["final_observation"], state.obs[:8], atol=1e-4)
        assert reward == pytest.approx(float(state.reward), abs=1e-4)
