"""Tests of ``python -m rtd3jax.export`` and the policies of a run directory."""

import dataclasses
import shutil

import jax
import numpy as np
import pytest
from random_policies import random_policy

import rtd3jax as rtd
from rtd3jax.envs import registry
from rtd3jax.export import main
from rtd3jax.study.cells import Cell
from rtd3jax.study.rundir import RunDirectory

CONFIG = rtd.Config(algorithm="h-td3", history_length=3, hidden_size=8, total_steps=100)
CURVES = {"steps": np.arange(1), "returns": np.zeros(1), "true_returns": np.zeros(1)}


def _cell(env="rover", disturbance="ar1-slip", **changes):
    return Cell(env, disturbance, dataclasses.replace(CONFIG, **changes))


CELLS = [_cell(), _cell(history_length=5), _cell(algorithm="lstm-td3"), _cell("pendulum", "hidden")]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run directory: seed 0 of every cell is trained, seed 1 of the first was lost."""
    directory = RunDirectory.create(tmp_path_factory.mktemp("run"), CELLS, [0, 1, 2], 1)
    for cell in CELLS:
        policy = random_policy(cell.config.algorithm, cell.make_env(), length=3)
        directory.lanes.write_lane(cell, 0, policy.parameters(), CURVES, {}, None)
    directory.lanes.write_lane(
        CELLS[0], 1, {}, CURVES, {}, {"step": 7, "reason": "loss is not finite"}
    )
    return directory.path


def test_a_lane_of_a_run_directory_becomes_a_policy(run):
    policy = rtd.load_policy(run, algorithm="lstm-td3")
    expected = random_policy("lstm-td3", rtd.make("rover", "ar1-slip"))
    jax.tree.map(np.testing.assert_array_equal, policy.actor, expected.actor)
    jax.tree.map(np.testing.assert_array_equal, policy.bounds, expected.bounds)
    assert policy.history_length == 3 and policy.window_tokens == 3
    hidden = rtd.load_policy(run, env="pendulum")
    assert hidden.observation_size == 2 and hidden.bounds.high.tolist() == [2.0]


@pytest.mark.parametrize(
    "which, message",
    [
        ({}, "4 cells of .* agree with the arguments; choose env: rover, pendulum"),
        ({"env": "rover"}, "choose algorithm: h-td3, lstm-td3"),
        ({"env": "rover", "algorithm": "h-td3"}, "choose history_length: 3, 5"),
        (
            {"algorithm": "td3"},
            "no such cell with algorithm=td3; its values of algorithm are h-td3 and",
        ),
        (
            {"env": "pendulum", "disturbance": "noise"},
            "no such cell .* values of disturbance are hidden",
        ),
        ({"env": "pendulum", "seed": 9}, r"no seed 9; its seeds are \[0, 1, 2\]"),
        ({"env": "pendulum", "seed": True}, "seed must be an integer of at least 0, not True"),
        ({"env": "pendulum", "seed": 2}, "seed 2 is not trained yet"),
        ({"env": "rover", "history_length": 3, "algorithm": "h-td3", "seed": 1}, "was lost .*loss"),
    ],
)
def test_what_cannot_be_chosen_is_named(run, which, message):
    with pytest.raises(rtd.UserError, match=message):
        rtd.load_policy(run, **which)


def test_a_seed_of_a_column_of_floats_is_a_seed(run):
    assert rtd.load_policy(run, env="pendulum", seed=0.0).observation_size == 2


def test_a_lane_for_another_observation_is_refused(tmp_path):
    directory = RunDirectory.create(tmp_path / "run", [_cell("pendulum", "random-sine")], [0], 1)
    other = random_policy("h-td3", rtd.make("pendulum", "hidden"))
    directory.lanes.write_lane(directory.cells[0], 0, other.parameters(), CURVES, {}, None)
    with pytest.raises(rtd.UserError, match="does not fit h-td3 with 3 observation elements"):
        rtd.load_policy(tmp_path / "run")


def test_a_lane_file_alone_is_refused_with_the_way(run):
    lane = next(run.glob("lanes/*pendulum*/seed-0.safetensors"))
    with pytest.raises(rtd.UserError, match=r"load_policy\('.*run0', algorithm=..., seed=0\)"):
        rtd.load_policy(lane)


def test_a_lane_of_an_environment_that_is_not_registered_is_loaded_and_exported(
    tmp_path, monkeypatch
):
    known = dict(registry._entries)
    monkeypatch.setattr(registry, "_entries", dict(registry._entries))
    rtd.register("robot", rtd.make("pendulum"), replace=True)
    cell = _cell("robot", "dropout")
    policy = random_policy("h-td3", cell.make_env())
    directory = RunDirectory.create(tmp_path / "run", [cell], [0, 1], 1)
    directory.lanes.write_lane(cell, 0, policy.parameters(), CURVES, {}, None, policy.interface())
    directory.lanes.write_lane(
        cell, 1, policy.parameters(), CURVES, {}, None
    )  # as older versions did
    old = rtd.load_policy(tmp_path / "run", seed=1)
    monkeypatch.setattr(registry, "_entries", known)
    loaded = rtd.load_policy(tmp_path / "run")
    for other in (old, loaded):
        assert other.interface() == policy.interface()
        jax.tree.map(np.testing.assert_array_equal, other.actor, policy.actor)
    out = tmp_path / "robot.py"
    assert main([str(tmp_path / "run"), "--format", "numpy", "--out", str(out)]) == 0
    assert out.exists()
    with pytest.raises(rtd.UserError, match="unknown environment 'robot'"):
        rtd.load_policy(tmp_path / "run", seed=1)
    directory.lanes.write_lane(
        cell, 0, policy.parameters(), CURVES, {}, None, {"observation_size": 0}
    )
    with pytest.raises(rtd.UserError, match="damaged: its header's observation_size is 0"):
        rtd.load_policy(tmp_path / "run")


@pytest.mark.parametrize("form", ["onnx", "stablehlo", "numpy", "policy"])
def test_the_command_writes_every_form(run, tmp_path, monkeypatch, capsys, form):
    monkeypatch.chdir(tmp_path)
    arguments = [str(run), "--agent", "h-td3", "--history-length", "5", "--format", form]
    assert main(arguments) == 0
    (path,) = tmp_path.iterdir()
    assert capsys.readouterr().out.startswith(f"{path.name}: h-td3 l=5, 2 observation elements")
    before = path.read_bytes()
    assert main(arguments) == 2
    assert capsys.readouterr().err == (
        f"error: {path.name} exists; say overwrite=True (--force) to replace it\n"
    )
    assert main([*arguments, "--force"]) == 0
    assert path.read_bytes() == before


def test_the_command_reads_a_saved_policy(run, tmp_path, capsys):
    saved = tmp_path / "p.safetensors"
    assert main([str(run), "--env", "pendulum", "--format", "policy", "--out", str(saved)]) == 0
    assert main([str(saved), "--format", "numpy"]) == 0
    assert (tmp_path / "p.py").exists()
    with_hyphens = saved.with_name("my-p.v2.safetensors")
    shutil.copy(saved, with_hyphens)
    assert main([str(with_hyphens), "--format", "numpy"]) == 0
    assert (tmp_path / "my_p.v2.py").exists()
    assert main([str(with_hyphens), "--format", "onnx"]) == 0
    assert (tmp_path / "my-p.v2.onnx").exists()
    capsys.readouterr()
    assert main([str(saved), "--format", "onnx", "--seed", "0"]) == 2
    assert "p.safetensors is not a run directory: seed cannot choose a lane" in (
        capsys.readouterr().err
    )
    assert main([str(tmp_path / "absent"), "--format", "onnx"]) == 2
    assert "absent cannot be read" in capsys.readouterr().err
