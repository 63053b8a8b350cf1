"""Each exported form drives its own plant; the trained policy, seeing the same, would do the same.

All agents and forms drive side by side, two episodes of 200 steps each.
"""

import dataclasses
import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest
from random_policies import random_policy

import rtd3jax as rtd
from rtd3jax.agents.bounds import Bounds
from rtd3jax.policies.export.formats import FORMATS

WORLDS = {"pendulum": "random-sine", "rover": "ar1-slip"}
EPISODES, STEPS = 2, 200
TOLERANCE = 1e-5


class OnnxPlayer:
    def __init__(self, path):
        self.session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])

    def reset(self):
        _, *states = self.session.get_inputs()
        self.state = {s.name: np.zeros((1, *s.shape[1:]), np.float32) for s in states}

    def step(self, observation):
        action, *state = self.session.run(None, {"observation": observation[None], **self.state})
        self.state = dict(zip(self.state, state, strict=True))
        return action[0]


class StableHloPlayer:
    def __init__(self, path):
        self.policy = rtd.load_stablehlo(path)

    def reset(self):
        self.state = self.policy.init()

    def step(self, observation):
        action, self.state = self.policy.step(self.state, observation[None])
        return action[0]


def numpy_player(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Player()


PLAYERS = {"onnx": OnnxPlayer, "stablehlo": StableHloPlayer, "numpy": numpy_player}


@pytest.fixture(scope="module", params=WORLDS)
def driven(request, tmp_path_factory):
    """Policies by agent; observations and actions [EPISODES, STEPS, agents, forms, ...]."""
    env = rtd.make(request.param, WORLDS[request.param])
    directory = tmp_path_factory.mktemp(request.param)
    policies = {name: random_policy(name, env) for name in rtd.ALGORITHMS}
    players = []
    for name, policy in policies.items():
        for form in FORMATS:
            path = directory / (name.replace("-", "_") + FORMATS[form][0])
            policy.export(path, format=form)
            players.append(PLAYERS[form](path))
    axes = (0, 0, 0, None)
    reset = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))
    step = jax.jit(lambda *args: jax.vmap(env.step, in_axes=axes)(*args)[:2])
    observations, actions = [], []
    for episode in range(EPISODES):
        keys = jax.random.split(jax.random.key(episode), len(players))
        observation, state = reset(keys, env.default_params)
        for player in players:
            player.reset()
        for _ in range(STEPS):
            seen = np.asarray(observation)
            done = np.stack([p.step(row) for p, row in zip(players, seen, strict=True)])
            observation, state = step(keys, state, done, env.default_params)
            observations.append(seen)
            actions.append(done)
    shape = (EPISODES, STEPS, len(policies), len(FORMATS), -1)
    return policies, np.reshape(observations, shape), np.reshape(actions, shape)


@jax.jit
def _replay(policy, observations):
    """Actions for observations [EPISODES, STEPS, forms, O]."""

    def episode(rows):
        def step(state, row):
            action, state = policy.step(state, row)
            return state, action

        return jax.lax.scan(step, policy.init(), rows)[1]

    return jax.vmap(jax.vmap(episode, in_axes=1, out_axes=1))(observations)


@pytest.mark.parametrize("algorithm", rtd.ALGORITHMS)
def test_every_form_acts_as_the_trained_policy(driven, algorithm):
    policies, observations, actions = driven
    policy, index = policies[algorithm], rtd.ALGORITHMS.index(algorithm)
    expected = np.asarray(_replay(policy, observations[:, :, index]))
    for form, name in enumerate(FORMATS):
        np.testing.assert_allclose(
            actions[:, :, index, form],
            expected[:, :, form],
            atol=TOLERANCE,
            rtol=0,
            err_msg=name,
        )
    # Neither constant nor always at a bound: a wrong form would show.
    half_range = np.asarray(policy.bounds.half_range)
    assert np.all(np.std(expected, axis=(0, 1, 2)) > 1_000 * TOLERANCE)
    assert np.mean(np.abs(expected) < 0.95 * half_range) > 0.2


def test_one_onnx_and_one_stablehlo_file_serve_every_batch_size(tmp_path):
    env = rtd.make("pendulum", "hidden")
    policy = random_policy("lstm-td3", env)
    policy.export(tmp_path / "p.onnx", format="onnx")
    policy.export(tmp_path / "p.stablehlo", format="stablehlo")
    session = onnxruntime.InferenceSession(tmp_path / "p.onnx", providers=["CPUExecutionProvider"])
    program = rtd.load_stablehlo(tmp_path / "p.stablehlo")
    rows = np.random.default_rng(0).normal(size=(4, 5, 2)).astype(np.float32)
    expected = _replay(policy, jnp.asarray(rows)[None])[0]
    state = program.init(5)
    onnx_state = {name: np.zeros(value.shape, np.float32) for name, value in state.items()}
    for row, action in zip(rows, expected, strict=True):
        found, state = program.step(state, row)
        onnx_action, *after = session.run(None, {"observation": row, **onnx_state})
        onnx_state = dict(zip(onnx_state, after, strict=True))
        np.testing.assert_allclose(found, action, atol=1e-5)
        np.testing.assert_allclose(onnx_action, action, atol=1e-5)


def _play(player, observations):
    player.reset()
    return np.stack([player.step(row) for row in observations])


@pytest.mark.parametrize("memory, length", [("lstm", 1), ("gru", 1), ("gru", 3), ("min-gru", 3)])
@pytest.mark.parametrize("agent", ["lstm-td3", "lstm-td3-1ha1hc"])
def test_windows_of_every_memory_in_every_form(tmp_path, agent, memory, length):
    policy = random_policy(
        agent, rtd.make("rover", "ar1-slip"), memory=memory, length=length, scale=2.0
    )
    rows = np.random.default_rng(0).normal(size=(1, 8, 1, 2)).astype(np.float32)
    expected = np.asarray(_replay(policy, rows))[0, :, 0]
    assert np.ptp(expected, axis=0).min() > 1e-2
    for form in FORMATS:
        path = tmp_path / ("p" + FORMATS[form][0])
        policy.export(path, format=form)
        found = _play(PLAYERS[form](path), rows[0, :, 0])
        np.testing.assert_allclose(found, expected, atol=TOLERANCE, err_msg=form)


@pytest.mark.parametrize("form", ["onnx", "stablehlo"])
@pytest.mark.parametrize("agent", rtd.ALGORITHMS)
def test_the_action_after_a_nan_is_nan(tmp_path, agent, form):
    """Of agents that read no actions, it leaves with the window (three steps)."""
    policy = random_policy(agent, rtd.make("rover", "ar1-slip"))
    path = tmp_path / ("p" + FORMATS[form][0])
    policy.export(path, format=form)
    rows = np.zeros((8, 2), np.float32)
    rows[2] = np.nan
    found = np.isnan(_play(PLAYERS[form](path), rows)).all(axis=1)
    ends = {"td3": 3, "lstm-td3-no-action": 6}.get(agent, 8)
    np.testing.assert_array_equal(found, [2 <= step < ends for step in range(8)])


@pytest.mark.parametrize("form", FORMATS)
def test_a_saturated_action_is_a_bound_exactly(form, tmp_path):
    """In float32, 0.3 - 0.6 is less than -0.3."""
    policy = random_policy("td3", rtd.make("pendulum"))
    bounds = Bounds(jnp.float32([-0.3]), jnp.float32([0.9]))
    output = {"kernel": 0.0 * policy.actor["output"]["kernel"], "bias": jnp.float32([-50.0])}
    policy = dataclasses.replace(policy, bounds=bounds, actor={**policy.actor, "output": output})
    path = tmp_path / ("saturated" + FORMATS[form][0])
    policy.export(path, format=form)
    player = PLAYERS[form](path)
    player.reset()
    action = np.asarray(player.step(np.zeros(3, np.float32)))
    assert action == np.float32(-0.3) == np.asarray(policy.step(policy.init(), jnp.zeros(3))[0])
