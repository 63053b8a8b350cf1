"""Files of earlier versions stay readable: policies that act as they did, tables that are the same.

tests/golden/make.py says what wrote them.
"""

import pathlib
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pandas as pd
import pytest

import rtd3jax as rtd
from rtd3jax.study.derive import derive
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import read_arrays

GOLDEN = pathlib.Path(__file__).parent / "golden"
EXPECTED = np.load(GOLDEN / "actions.npz")
NAMES = sorted(name.removesuffix(".actions") for name in EXPECTED if name.endswith(".actions"))


@jax.jit
def _play(policy, observations):
    def step(state, observation):
        action, state = policy.step(state, observation)
        return state, action

    return jax.lax.scan(step, policy.init(), jnp.asarray(observations))[1]


def test_there_is_a_policy_of_each_agent_in_each_environment():
    assert len(NAMES) == 3 * len(rtd.ALGORITHMS)
    assert all(read_arrays(GOLDEN / f"{name}.safetensors")[1]["format"] == 1 for name in NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_policy_acts_as_it_did(tmp_path, name):
    policy = rtd.load_policy(GOLDEN / f"{name}.safetensors")
    seen, expected = EXPECTED[f"{name}.observations"], EXPECTED[f"{name}.actions"]
    np.testing.assert_allclose(_play(policy, seen), expected, rtol=1e-5, atol=1e-5)
    assert np.ptp(expected) > 1e-2
    # Also when it is saved by this version, and in the forms that run without it.
    policy.save(tmp_path / "p.safetensors")
    again = rtd.load_policy(tmp_path / "p.safetensors")
    np.testing.assert_array_equal(_play(again, seen), _play(policy, seen))
    policy.export(tmp_path / "p.py", format="numpy")
    names: dict = {}
    exec((tmp_path / "p.py").read_text(), names)
    player = names["Player"]()
    np.testing.assert_allclose([player.step(row) for row in seen], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["shifted-lstm-td3", "shifted-h-td3", "shifted-td3"])
def test_a_policy_whose_range_is_not_about_zero_leaves_as_it_was(tmp_path, name):
    policy = rtd.load_policy(GOLDEN / f"{name}.safetensors")
    seen, expected = EXPECTED[f"{name}.observations"], EXPECTED[f"{name}.actions"]
    policy.export(tmp_path / "p.onnx", format="onnx")
    policy.export(tmp_path / "p.stablehlo", format="stablehlo")
    program = rtd.load_stablehlo(tmp_path / "p.stablehlo")
    session = onnxruntime.InferenceSession(tmp_path / "p.onnx", providers=["CPUExecutionProvider"])
    state = program.init()
    onnx_state = {key: np.zeros(value.shape, np.float32) for key, value in state.items()}
    for row, action in zip(seen, expected, strict=True):
        found, state = program.step(state, row[None])
        np.testing.assert_allclose(found[0], action, rtol=1e-5, atol=1e-5)
        found, *after = session.run(None, {"observation": row[None], **onnx_state})
        onnx_state = dict(zip(onnx_state, after, strict=True))
        np.testing.assert_allclose(found[0], action, rtol=1e-5, atol=1e-5)


def test_a_run_directory_gives_the_same_tables_and_policies(tmp_path):
    path = tmp_path / "run"
    shutil.copytree(GOLDEN / "run", path)
    for table in ("curves", "episodes"):
        (path / f"{table}.parquet").unlink()
    directory = RunDirectory.open(path)
    derive(directory, [], pictures=False)
    for table in ("curves", "episodes"):
        expected = pd.read_parquet(GOLDEN / "run" / f"{table}.parquet")
        expected = expected[expected["seed"] >= 0].reset_index(drop=True)
        pd.testing.assert_frame_equal(pd.read_parquet(path / f"{table}.parquet"), expected)
    env = rtd.make("pendulum", "random-sine")
    policy = rtd.load_policy(path, algorithm="lstm-td3-1ha1hc", seed=1)
    kept = expected[(expected["algorithm"] == "lstm-td3-1ha1hc") & (expected["seed"] == 1)]
    returns = rtd.evaluate(policy, env, episodes=len(kept), seed=1)
    np.testing.assert_allclose(returns, kept["return"], rtol=1e-4)


def test_lanes_are_not_added_to_a_study_whose_agents_read_other_units(tmp_path):
    path = tmp_path / "run"
    shutil.copytree(GOLDEN / "run", path)
    cells, seeds = RunDirectory.open(path).cells, RunDirectory.open(path).seeds
    RunDirectory.create(path, cells, seeds, 3)  # complete: nothing would be trained
    next((path / "lanes").rglob("seed-1.safetensors")).unlink()
    with pytest.raises(rtd.UserError, match="begun by rtd3jax 0.1.*choose another directory"):
        RunDirectory.create(path, cells, seeds, 3)
