"""Tests that a study does not mix different plants of the same name."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces

import rtd3jax as rtd
from rtd3jax.study.cells import Cell
from rtd3jax.study.plant_code import code_of
from rtd3jax.study.robustness import run_robustness
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.transfer import transfer


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
        rtd.UserError,
        match=r"another plant .* tank-of-a-study none \(env.drain: 0.08 there, 0.02 here\)",
    ):
        study(tmp_path, 0.02)


@pytest.mark.parametrize("name", ("noisy", "logged"))
def test_what_was_added_is_held_too(tmp_path, name):
    """Also a process, and a recording."""
    study(tmp_path, 0.08)
    study(tmp_path, 0.08, ("none", name))
    with pytest.raises(rtd.UserError, match=f"another plant .* tank-of-a-study {name}"):
        study(tmp_path, 0.08, (name,), noise=0.3)


def register_changed(**changes):
    """Register the tank again, with other methods: another class of the same name."""
    changed = type("Tank", (Tank,), changes)
    rtd.register("tank-of-a-study", changed(), {"noisy": rtd.GaussianNoise(0.1)}, replace=True)


def other_reward(self, key, state, action, params):
    obs, state, _, terminated, info = Tank.step_env(self, key, state, action, params)
    return obs, state, -jnp.abs(obs[0]), terminated, info


def plan_now(path, disturbances=("none",)):
    config = rtd.Config("td3", total_steps=200)
    cells = [Cell("tank-of-a-study", name, config) for name in disturbances]
    return RunDirectory(path, cells, [0], 2).plan()


def test_other_code_of_a_plant_is_noticed(tmp_path):
    study(tmp_path, 0.08, ("none", "noisy"))
    assert plan_now(tmp_path, ("none", "noisy")) == ""
    register_changed()  # the same code in another class
    assert plan_now(tmp_path, ("none", "noisy")) == ""
    register_changed(step_env=other_reward)
    news = plan_now(tmp_path, ("none", "noisy")).splitlines()
    assert len(news) == 2
    assert all(
        f"the code of tank-of-a-study {name} computes" in line
        for name, line in zip(("none", "noisy"), news, strict=True)
    )


def test_code_is_compared_only_as_one_version_of_jax_writes_it(tmp_path):
    study(tmp_path, 0.08)
    register_changed(step_env=other_reward)
    file = tmp_path / "config.json"
    content = json.loads(file.read_text())
    content["plants"]["tank-of-a-study none"]["code"]["jax"] = "0.0.1"
    file.write_text(json.dumps(content))
    assert plan_now(tmp_path) == ""


def test_the_settings_of_a_process_are_not_code(tmp_path):
    study(tmp_path, 0.08)
    with jax.default_matmul_precision("float32"), jax.enable_x64(True):
        assert plan_now(tmp_path) == ""
    with jax.disable_jit():
        assert plan_now(tmp_path) == ""


def test_other_bounds_of_actions_make_another_plant(tmp_path):
    study(tmp_path, 0.08)
    register_changed(action_space=lambda self, params: spaces.Box(-2.0, 1.0, (1,)))
    with pytest.raises(rtd.UserError, match=r"another plant .* \(actions: .*-1.0.*-2.0"):
        plan_now(tmp_path)


def test_a_plant_that_calls_python_has_no_code_to_compare(tmp_path):
    def calls_back(self, key, state, action, params):
        jax.debug.callback(lambda level: None, action[0])
        return Tank.step_env(self, key, state, action, params)

    register_changed(step_env=calls_back)
    config = rtd.Config("td3", total_steps=200)
    RunDirectory.create(tmp_path, [Cell("tank-of-a-study", "none", config)], [0], 2)
    plants = json.loads((tmp_path / "config.json").read_text())["plants"]
    assert plants["tank-of-a-study none"]["code"] is None
    assert plan_now(tmp_path) == ""


def test_the_digest_of_code_is_equal_in_every_process_and_leaves_out_names_and_numbers():
    command = (
        "import rtd3jax as rtd; from rtd3jax.study.plant_code import code_of; "
        "env = rtd.make('pendulum', 'random-sine'); print(code_of(env, env.default_params))"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    asked = [sys.executable, "-c", command]
    there = subprocess.run(asked, env=environment, capture_output=True, text=True, check=True)
    env = rtd.make("pendulum", "random-sine", m=1.3)
    here = code_of(env, env.default_params)
    assert here is not None and there.stdout.strip() == str(here)

    def helped(name):
        @jax.jit
        def helper(action):
            return 2.0 * action

        helper.__wrapped__.__name__ = name

        class Helped(Tank):
            def step_env(self, key, state, action, params):
                return super().step_env(key, state, jax.jit(helper.__wrapped__)(action), params)

        return code_of(Helped(), Params())

    assert helped("a_callback") == helped("twice") is not None
    assert helped("twice") != code_of(Tank(), Params())


def test_code_that_a_cpu_cannot_run_is_not_compared(monkeypatch):
    def fails(*_, **__):
        raise ValueError("Only interpret mode is supported on CPU backend.")

    monkeypatch.setattr(jax, "eval_shape", fails)
    assert code_of(Tank(), Params()) is None


def test_cells_that_are_continued_without_a_name_are_compared_too(tmp_path):
    study(tmp_path, 0.08, ("none", "noisy"))
    rtd.register("tank-of-a-study", Tank(), {"noisy": rtd.GaussianNoise(0.4)}, replace=True)
    with pytest.raises(rtd.UserError, match="another plant .* tank-of-a-study noisy"):
        plan_now(tmp_path, ("none",))
    rtd.register("tank-of-a-study", Tank(), replace=True)
    assert "continued" in plan_now(tmp_path, ("none",))  # noisy can be read, but not trained


def trained_study(path):
    register_changed()
    cells = [
        Cell(env, "none", rtd.Config("td3", total_steps=200))
        for env in ("tank-of-a-study", "rover")
    ]
    rtd.Study(cells, seeds=[0], out=path, final_episodes=2).run(quiet=True, page=False)
    return RunDirectory.open(path)


def test_trained_agents_are_tested_only_on_the_plant_of_their_study(tmp_path):
    directory, lines = trained_study(tmp_path), []
    tests = {
        "transfer": lambda: transfer(directory, ["none"], 2, lines.append),
        "to another": lambda: transfer(directory, ["dropout"], 2, lines.append),
        "stress": lambda: run_robustness(directory, ["noise=0.1"], 2, lines.append),
    }
    for test in tests.values():
        assert set(test()["env"]) == {"tank-of-a-study", "rover"}
    assert lines == []
    register_changed(step_env=other_reward)
    for test in tests.values():
        assert set(test()["env"]) == {"tank-of-a-study", "rover"}
        (line,) = lines
        assert "the code of tank-of-a-study none computes something else" in line
        lines.clear()
    rtd.register("tank-of-a-study", Tank(0.02), replace=True)
    for test in tests.values():
        assert set(test()["env"]) == {"rover"}  # what can be tested is tested
        assert "another plant" in lines.pop() and not lines


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


@pytest.mark.parametrize("test", (transfer, run_robustness))
def test_a_read_only_study_is_refused_before_anything_is_played(tmp_path, test, monkeypatch):
    study(tmp_path, 0.08)
    monkeypatch.setattr(os, "access", lambda *_: False)  # the superuser may write everywhere
    with pytest.raises(rtd.UserError, match="cannot be written"):
        test(RunDirectory.open(tmp_path), None, 2)
