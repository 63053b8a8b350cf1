"""Tests that a study does not mix different plants of the same name."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces

import rtd3jax as rtd
from rtd3jax.study.plan import Cell
from rtd3jax.study.rundir import RunDirectory


@struct.dataclass
class Params:
    drain: float = 0.08
    max_steps_in_episode: int = 5


class Tank(environment.Environment):
    def __init__(self, drain=0.08):
        super().__init__()
        self.drain = drain

    @property
    def default_params(self):
        return Params(drain=self.drain)

    def reset_env(self, key, params):
        return jnp.zeros(1), jnp.int32(0)

    def step_env(self, key, state, action, params):
        level = jnp.sum(action) - params.drain
        return level[None], state + jnp.int32(1), -level, jnp.array(False), {}

    def is_truncated(self, state, params):
        return state >= params.max_steps_in_episode

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (1,))


def study(path, drain, disturbances=("none",), noise=0.1):
    processes = {
        "noisy": rtd.GaussianNoise(sigma=noise),
        "logged": rtd.Recorded(np.arange(9) * noise),
    }
    rtd.register("tank-of-a-study", Tank(drain), processes, replace=True)
    config = rtd.Config("td3", total_steps=200)
    cells = [Cell("tank-of-a-study", name, config) for name in disturbances]
    return RunDirectory.create(path, cells, [0], 2)


def test_a_changed_plant_of_the_same_name_is_refused_with_the_difference(tmp_path):
    study(tmp_path, 0.08)
    study(tmp_path, 0.08)  # the same plant, from another object
    with pytest.raises(
        rtd.UserError, match=r"another plant .* tank-of-a-study none \(params: \[0.08"
    ):
        study(tmp_path, 0.02)


def test_what_was_added_is_held_too(tmp_path):
    """Also a process, and a recording."""
    study(tmp_path, 0.08)
    study(tmp_path, 0.08, ("none", "noisy", "logged"))
    for name in ("noisy", "logged"):
        with pytest.raises(rtd.UserError, match=f"another plant .* tank-of-a-study {name}"):
            study(tmp_path, 0.08, (name,), noise=0.3)
    study(tmp_path, 0.08, ("none",), noise=0.3)  # which that plant does not have


def test_a_study_without_its_plants_goes_on_and_states_those_that_are_added(tmp_path):
    study(tmp_path, 0.08)
    file = tmp_path / "config.json"
    content = json.loads(file.read_text())
    del content["plants"]
    file.write_text(json.dumps(content))
    study(tmp_path, 0.02)
    study(tmp_path, 0.02, ("none", "noisy"))
    assert set(json.loads(file.read_text())["plants"]) == {
        "tank-of-a-study none",
        "tank-of-a-study noisy",
    }


def test_a_plant_is_the_same_in_every_process():
    """The identity holds no address of an object, nor a hash that differs between processes."""
    from rtd3jax.training.plant import plant_of

    env = rtd.make("pendulum", "random-sine")
    one, other = (json.dumps(plant_of(env, env.default_params)) for _ in range(2))
    assert one == other and " at 0x" not in one
    params = jax.tree.map(jnp.asarray, env.default_params)
    assert plant_of(env, params)["env"] == plant_of(env, env.default_params)["env"]
