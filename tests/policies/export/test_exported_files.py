"""Tests the contents of exported files, and refused files."""

import ast
import dataclasses
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest
from random_policies import random_policy

import rtd3jax as rtd
from rtd3jax.agents.memory import GRU
from rtd3jax.agents.networks import Linear
from rtd3jax.registries import AGENTS, MEMORIES
from rtd3jax.system.files import read_arrays, write_arrays
from rtd3jax.system.program_cache import forget_programs


@pytest.fixture(scope="module")
def policy():
    return random_policy("lstm-td3-1ha1hc", rtd.make("rover", "ar1-slip"))


@pytest.fixture(scope="module")
def program(policy, tmp_path_factory):
    path = tmp_path_factory.mktemp("program") / "p.stablehlo"
    policy.export(path, format="stablehlo")
    return path


def test_unknown_formats_are_refused(tmp_path, policy):
    with pytest.raises(rtd.UserError, match="'onx' is unknown; did you mean 'onnx'"):
        policy.export(tmp_path / "p", format="onx")
    with pytest.raises(rtd.UserError, match=r"must end in \.py"):
        policy.export(tmp_path / "p.txt", format="numpy")


@pytest.mark.parametrize("form, package", [("onnx", "onnx"), ("stablehlo", "flatbuffers")])
def test_a_missing_package_is_one_line(tmp_path, policy, monkeypatch, form, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(rtd.UserError, match=rf"{package}: pip install 'rtd3jax\[{form}\]'"):
        policy.export(tmp_path / "p", format=form)


def test_the_onnx_file_tells_its_state(tmp_path, policy):
    policy.export(tmp_path / "p.onnx", format="onnx")
    model = onnx.load(tmp_path / "p.onnx")
    header = json.loads({p.key: p.value for p in model.metadata_props}["rtd3jax"])
    assert header["algorithm"] == "lstm-td3-1ha1hc" and header["initial_state"] == "zeros"
    assert header["state"] == {"hidden": [3, 8], "cell": [3, 8], "previous_action": [2]}
    assert [i.name for i in model.graph.input] == ["observation", *header["state"]]
    outputs = [o.name for o in model.graph.output]
    assert outputs == ["action", *(f"next_{name}" for name in header["state"])]


def test_the_numpy_file_needs_nothing_but_numpy(tmp_path, policy):
    policy.export(tmp_path / "rover_policy.py", format="numpy")
    source = (tmp_path / "rover_policy.py").read_text()
    nodes = list(ast.walk(ast.parse(source)))
    imported = {a.name for n in nodes if isinstance(n, ast.Import) for a in n.names}
    imported |= {n.module for n in nodes if isinstance(n, ast.ImportFrom)}
    assert imported == {"base64", "typing", "numpy"}
    code = (
        "import sys, rover_policy; p = rover_policy.Player(); print(p.step([0.5, 0.0]).tolist())\n"
        "second = p.step([0, 0]); p.reset(); p.step([0.5, 0])\n"
        "assert (p.step([0, 0]) == second).all()\n"
        "p.reset(); assert (p.step([0, 0]) != second).any()\n"
        "assert 'jax' not in sys.modules and 'rtd3jax' not in sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    action, _ = policy.step(policy.init(), np.float32([0.5, 0.0]))
    np.testing.assert_allclose(json.loads(done.stdout), action, atol=1e-6)


def test_the_numpy_player_refuses_bad_observations_and_forgets_them(tmp_path, policy):
    policy.export(tmp_path / "p.py", format="numpy")
    names: dict = {}
    exec((tmp_path / "p.py").read_text(), names)
    player, other = names["Player"](), names["Player"]()
    for bad, message in (([1.0], r"\(2,\), not \(1,\)"), ([np.nan, 0.0], "not finite")):
        with pytest.raises(ValueError, match=message):
            player.step(bad)
    np.testing.assert_array_equal(player.step([1.0, 2.0]), other.step([1.0, 2.0]))
    # The caller may do with an action what it likes.
    player.step([0.0, 0.0])[:] = 9.0
    other.step([0.0, 0.0])
    np.testing.assert_array_equal(player.step([1.0, 2.0]), other.step([1.0, 2.0]))


@pytest.mark.parametrize("shape", [(), (1, 2)])
def test_actions_have_the_shape_of_the_environments(tmp_path, policy, shape):
    size = int(np.prod(shape))
    actor = {
        **policy.actor,
        "output": {n: a[..., :size] for n, a in policy.actor["output"].items()},
    }
    kernel = actor["encoder"]["kernel"]
    actor["encoder"] = {**actor["encoder"], "kernel": kernel[: 2 + size]}
    bounds = jax.tree.map(lambda b: b[:size], policy.bounds)
    shaped = policy.replace(
        actor=actor, bounds=bounds, centre_token=policy.centre_token[:size], action_shape=shape
    )
    shaped.save(tmp_path / "p")
    expected, _ = rtd.load_policy(tmp_path / "p").step(shaped.init(), np.float32([1.0, 2.0]))
    assert expected.shape == shape
    for form, name in (("numpy", "p.py"), ("onnx", "p.onnx"), ("stablehlo", "p.stablehlo")):
        shaped.export(tmp_path / name, format=form)
    names: dict = {}
    exec((tmp_path / "p.py").read_text(), names)
    np.testing.assert_allclose(names["Player"]().step([1.0, 2.0]), expected, atol=1e-5)
    program = rtd.load_stablehlo(tmp_path / "p.stablehlo")
    action, _ = program.step(program.init(), [[1.0, 2.0]])
    np.testing.assert_allclose(action[0], expected, atol=1e-5)
    session = onnxruntime.InferenceSession(tmp_path / "p.onnx", providers=["CPUExecutionProvider"])
    state = {name: np.zeros(value.shape, np.float32) for name, value in program.init().items()}
    action, *_ = session.run(None, {"observation": np.float32([[1.0, 2.0]]), **state})
    assert action.shape == (1, *shape)
    np.testing.assert_allclose(action[0], expected, atol=1e-5)


def test_a_stablehlo_file_holds_no_path_of_the_machine(program):
    content = bytes(read_arrays(program)[0]["program"])
    assert b".py" not in content and b"rtd3jax" not in content


def test_a_stablehlo_policy_refuses_other_observations(program):
    policy = rtd.load_stablehlo(program)
    for shape in ((2,), (1, 3)):
        with pytest.raises(rtd.UserError, match=r"shape \(batch, 2\), not"):
            policy.step(policy.init(), np.zeros(shape))
    action, _ = policy.step(policy.init(), np.zeros((1, 2)))  # float64 is converted
    assert action.shape == (1, 2)


@pytest.mark.parametrize("kind", [jnp.int32, jnp.float16, jnp.bfloat16])
def test_a_stablehlo_policy_converts_observations_to_float32(program, kind):
    policy = rtd.load_stablehlo(program)
    seen = np.array([[1.0, -2.0]], np.float32)
    expected, _ = policy.step(policy.init(), seen)
    for step in (policy.step, jax.jit(policy.step)):
        action, _ = step(policy.init(), jnp.asarray(seen, kind))
        np.testing.assert_allclose(action, expected, rtol=1e-5)
    with jax.enable_x64(True):
        action, _ = policy.step(policy.init(), jnp.asarray(seen, jnp.float64))
    np.testing.assert_allclose(action, expected, rtol=1e-5)


def test_what_is_no_stablehlo_policy_is_refused(program, tmp_path, policy):
    arrays, about = read_arrays(program)
    path = tmp_path / "p"
    with pytest.raises(rtd.UserError, match="cannot be read"):
        rtd.load_stablehlo(path)
    path.write_bytes(program.read_bytes()[:-9])
    with pytest.raises(rtd.UserError, match="cannot be read"):
        rtd.load_stablehlo(path)
    policy.save(path, overwrite=True)
    with pytest.raises(rtd.UserError, match="is not a policy in the StableHLO"):
        rtd.load_stablehlo(path)
    with pytest.raises(rtd.UserError, match="is not a saved policy"):
        rtd.load_policy(program)
    write_arrays(path, arrays, {**about, "format": 2})
    with pytest.raises(rtd.UserError, match="has format 2"):
        rtd.load_stablehlo(path)
    write_arrays(path, {"program": arrays["program"][:100]}, about)
    with pytest.raises(rtd.UserError, match="cannot be read by this version of JAX"):
        rtd.load_stablehlo(path)


@pytest.fixture
def own_tables(monkeypatch):
    """What a test registers is gone afterwards."""
    for registry in (AGENTS, MEMORIES):
        monkeypatch.setattr(registry, "_entries", dict(registry._entries))
    yield
    monkeypatch.undo()
    forget_programs()


class _DoubledGRU(GRU):
    """A GRU with another output of the same parameters."""

    def read(self, carry):
        return 2.0 * super().read(carry)


class _Average(rtd.Memory):
    """A memory without parameters."""

    def zero(self, batch):
        return jnp.zeros((batch, self.width))

    def step(self, carry, token):
        return 0.5 * (carry + token)


class _DoubledLinear(Linear):
    """A linear layer with another output of the same parameters."""

    def __call__(self, x):
        return 2.0 * super().__call__(x)


@pytest.mark.parametrize(
    ("memory", "module", "message"),
    [
        ("gru", _DoubledGRU, "not 'gru', which another module has replaced here; export"),
        ("lstm", _Average, "not 'lstm', which another module has replaced here; export"),
        ("gru", None, "does not support this agent's encoder; export it as stablehlo"),
    ],
)
def test_modules_in_place_of_the_packages_are_only_exported_as_they_are(
    tmp_path, own_tables, memory, module, message
):
    env, algorithm = rtd.make("rover", "ar1-slip"), "lstm-td3-1ha1hc"
    if module is None:
        variant = dataclasses.replace(AGENTS[algorithm], encoder=_DoubledLinear)
        rtd.register_agent("doubled", variant)
        algorithm = "doubled"
    else:
        rtd.register_memory(memory, module, replace=True)
    policy = random_policy(algorithm, env, memory=memory)
    for form, name in (("numpy", "p.py"), ("onnx", "p.onnx")):
        with pytest.raises(rtd.UserError, match=message):
            policy.export(tmp_path / name, format=form)
    policy.export(tmp_path / "p.stablehlo", format="stablehlo")
    program = rtd.load_stablehlo(tmp_path / "p.stablehlo")
    state, own = program.init(), policy.init()
    for observation in np.random.default_rng(0).normal(size=(5, 2)).astype(np.float32):
        expected, own = policy.step(own, observation)
        action, state = program.step(state, observation[None])
        np.testing.assert_allclose(action[0], expected, atol=1e-5)
