"""Tests that saved policies are restored bit by bit, and that bad files are refused."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_policies import random_policy

import rtd3jax as rtd
from rtd3jax.system.files import read_arrays, write_arrays


@pytest.fixture(scope="module")
def env():
    return rtd.make("rover", "ar1-slip")


@pytest.fixture(scope="module")
def policy(env):
    return random_policy("lstm-td3", env)


def _rewritten(path, change_arrays=lambda a: a, **changes):
    """A sound file (its checksum agrees) with other contents."""
    arrays, about = read_arrays(path)
    write_arrays(path, change_arrays(dict(arrays)), {**about, **changes})
    return path


@pytest.mark.parametrize("algorithm", rtd.ALGORITHMS)
def test_what_was_saved_comes_back(tmp_path, env, algorithm):
    saved = random_policy(algorithm, env)
    saved.save(tmp_path / "policy.safetensors")
    loaded = rtd.load_policy(tmp_path / "policy.safetensors")
    jax.tree.map(np.testing.assert_array_equal, saved.actor, loaded.actor)
    jax.tree.map(np.testing.assert_array_equal, saved.bounds, loaded.bounds)
    assert loaded.algorithm == algorithm and loaded.action_shape == saved.action_shape
    assert loaded.history_length == saved.history_length == loaded.window_tokens
    # Not a byte of it depends on when or how often it was saved.
    loaded.save(tmp_path / "again.safetensors")
    first, second = (tmp_path / f"{n}.safetensors" for n in ("policy", "again"))
    assert first.read_bytes() == second.read_bytes()


def test_the_header_is_json_that_anyone_can_read(tmp_path, policy):
    policy.save(tmp_path / "p.safetensors")
    data = (tmp_path / "p.safetensors").read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    about = json.loads(header["__metadata__"]["rtd3jax"])["about"]
    assert about["algorithm"] == "lstm-td3" and about["history_length"] == 3
    assert about["action_low"] == [-1.0, -1.0] and about["action_high"] == [1.0, 1.0]
    assert about["observation_size"] == 2 and about["hidden_size"] == 8 and about["format"] == 2
    assert about["versions"]["jax"] == jax.__version__


def test_nothing_is_overwritten_unasked(tmp_path, policy):
    path = tmp_path / "p.safetensors"
    path.write_text("mine")
    with pytest.raises(rtd.UserError, match="exists; say overwrite=True"):
        policy.save(path)
    with pytest.raises(rtd.UserError, match="exists; say overwrite=True"):
        policy.export(path, format="onnx")
    assert path.read_text() == "mine"
    policy.save(path, overwrite=True)
    assert rtd.load_policy(path).algorithm == "lstm-td3"
    with pytest.raises(rtd.UserError, match="is a directory"):
        policy.save(tmp_path, overwrite=True)
    with pytest.raises(rtd.UserError, match=r"below cannot be written \(.*p.safetensors: File e"):
        policy.save(path / "below")


def test_weights_that_are_not_finite_are_refused_both_ways(tmp_path, policy):
    actor = jax.tree.map(jnp.copy, policy.actor)
    actor["head"]["bias"] = actor["head"]["bias"].at[0].set(jnp.nan)
    broken = policy.replace(actor=actor)
    for write in (broken.save, lambda path: broken.export(path, "numpy")):
        with pytest.raises(rtd.UserError, match=r"not finite \(head.bias\)"):
            write(tmp_path / "p.py")
    assert not list(tmp_path.iterdir())
    policy.save(tmp_path / "p")
    _rewritten(tmp_path / "p", lambda a: a | {"head.bias": np.full(8, np.inf, np.float32)})
    with pytest.raises(rtd.UserError, match=r"not finite \(head.bias\)"):
        rtd.load_policy(tmp_path / "p")


def test_a_batch_of_policies_is_refused(tmp_path, policy):
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), policy)
    for write in (batch.save, lambda path: batch.export(path, "onnx")):
        with pytest.raises(rtd.UserError, match="one by one"):
            write(tmp_path / "p")


@pytest.mark.parametrize(
    "change, message",
    [
        (
            lambda a: {n: v for n, v in a.items() if n != "memory.input_bias"},
            "lacks .*memory.input_b",
        ),
        (lambda a: a | {"more.kernel": np.zeros(1)}, "unexpected array: more.kernel"),
        (lambda a: a | {"head.kernel": np.zeros((3, 8), np.float32)}, r"\[3, 8\], not \[16, 8\]"),
        (lambda a: a | {"head.bias": np.zeros(8)}, "float64, not float32"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path, policy, change, message):
    policy.save(tmp_path / "p")
    _rewritten(tmp_path / "p", change)
    with pytest.raises(rtd.UserError, match=message):
        rtd.load_policy(tmp_path / "p")


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"format": 5}, "has format 5, .* reads up to 4"),
        ({"format": 4}, "arrays do not agree with its format"),
        ({"centre_token": [0.0]}, "centre_token is not 2 numbers"),
        ({"kind": "shopping list"}, "is not a saved policy"),
        ({"algorithm": "ppo"}, "agent .ppo. is not known here"),
        ({"memory": "hippocampus"}, "memory .hippocampus. is not known here.*rtd.register_memory"),
        ({"history_length": 0}, "history_length is 0"),
        ({"hidden_size": True}, "hidden_size is True"),
        ({"observation_size": "2"}, "observation_size is '2'"),
        ({"observation_size": 3}, "with 3 observation elements"),
        ({"action_shape": 2}, "action_shape is 2"),
        ({"action_low": None}, "action bounds"),
        ({"action_low": [-1.0, float("nan")]}, "action bounds"),
        ({"action_high": [1.0, -1.0]}, "2 pairs of low < high"),
        ({"action_high": [1.0]}, "2 pairs of low < high"),
    ],
)
def test_headers_that_do_not_fit_are_refused(tmp_path, policy, changes, message):
    policy.save(tmp_path / "p")
    _rewritten(tmp_path / "p", **changes)
    with pytest.raises(rtd.UserError, match=message):
        rtd.load_policy(tmp_path / "p")


def test_what_is_no_policy_is_refused(tmp_path, policy):
    path = tmp_path / "p"
    with pytest.raises(rtd.UserError, match="p cannot be read"):
        rtd.load_policy(path)
    with pytest.raises(rtd.UserError, match="there is no study in"):
        rtd.load_policy(tmp_path)
    for content in (b"", b"hello", np.random.default_rng(0).bytes(1000)):
        path.write_bytes(content)
        with pytest.raises(rtd.UserError, match="p cannot be read"):
            rtd.load_policy(path)
    policy.save(path, overwrite=True)
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    with pytest.raises(rtd.UserError, match="p cannot be read"):
        rtd.load_policy(path)
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(rtd.UserError, match="checksum"):
        rtd.load_policy(path)
    write_arrays(path, {}, "a text")
    with pytest.raises(rtd.UserError, match="is not a saved policy"):
        rtd.load_policy(path)


def test_a_loaded_policy_refuses_another_environment(tmp_path, policy):
    policy.save(tmp_path / "p")
    loaded = rtd.load_policy(tmp_path / "p")
    with pytest.raises(rtd.UserError, match=r"shape \(2,\), not \(3,\)"):
        loaded.step(loaded.init(), np.zeros(3))
    with pytest.raises(rtd.UserError, match="expects 2 observation elements"):
        rtd.evaluate(loaded, rtd.make("pendulum"), episodes=1)


def test_a_reading_that_is_not_finite_is_refused_and_not_remembered(policy):
    """Where the host sees it; a traced step cannot refuse it."""
    state = policy.init()
    size = policy.observation_size
    action, state = policy.step(state, np.full(size, 0.1))
    for bad in (np.nan, -np.inf, 1e300):
        with pytest.raises(rtd.UserError, match="not finite, and the state is unchanged") as caught:
            policy.step(state, np.append(np.full(size - 1, 0.1), bad))
        assert "\n" not in str(caught.value)
    after, _ = policy.step(state, [0.1] * size)
    traced, _ = jax.jit(policy.step)(state, np.full(size, 0.1, np.float32))
    np.testing.assert_allclose(after, traced, atol=1e-6)
    assert np.isnan(jax.jit(policy.step)(state, np.full(size, np.nan, np.float32))[0]).all()


def test_a_step_outside_jit_is_compiled_once(policy, monkeypatch):
    state, observation = policy.init(), np.full(policy.observation_size, 0.1)
    _, state = policy.step(state, observation)
    monkeypatch.setattr(type(policy), "_step", None)  # what is traced again fails
    for _ in range(3):
        _, state = policy.step(state, observation)
    assert int(state.time) == 4


def test_a_batch_of_observations_gets_the_advice(policy):
    for step in (policy.step, jax.jit(policy.step)):
        with pytest.raises(rtd.UserError, match=r"observation\[0\], .* jax.vmap"):
            step(policy.init(), np.zeros((1, policy.observation_size)))


def test_a_misspelt_way_of_acting_is_refused(tmp_path, policy):
    wrong = policy.replace(acting="cary")
    for use in (wrong.init, lambda: wrong.save(tmp_path / "policy.safetensors")):
        with pytest.raises(rtd.UserError, match="acting 'cary' is unknown; did you mean 'carry'"):
            use()
    assert not list(tmp_path.iterdir())
