"""Tests running carries in every export format, and the size of their state."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_policies import random_policy
from test_closed_loop import PLAYERS

import rtd3jax as rtd
from rtd3jax.agents.normalise import Normaliser
from rtd3jax.policies.export.formats import FORMATS

STEPS = 20


@pytest.fixture(scope="module")
def env():
    return rtd.make("rover", "ar1-slip")


@pytest.fixture(scope="module")
def observations():
    return np.random.default_rng(0).normal(size=(STEPS, 2)).astype(np.float32)


def _actions(policy, observations):
    state, actions = policy.init(), []
    for observation in observations:
        action, state = policy.step(state, observation)
        actions.append(np.asarray(action))
    return np.stack(actions)


@pytest.mark.parametrize("memory", ["lstm", "gru", "min-gru"])
@pytest.mark.parametrize("agent", ["lstm-td3", "lstm-td3-1ha1hc"])
def test_it_acts_as_a_window_of_the_whole_episode_in_every_form(
    tmp_path, env, observations, agent, memory
):
    kind = dict(memory=memory, width=16, scale=2.0)
    whole = _actions(random_policy(agent, env, length=STEPS, **kind), observations)
    short = _actions(random_policy(agent, env, length=2, **kind), observations)
    policy = random_policy(agent, env, length=2, acting="carry", **kind)
    np.testing.assert_allclose(_actions(policy, observations), whole, atol=1e-5)
    assert np.abs(short - whole).max() > 1e-2
    for form in FORMATS:
        path = tmp_path / ("p" + FORMATS[form][0])
        policy.export(path, format=form)
        player = PLAYERS[form](path)
        for _ in range(2):  # a second episode begins anew
            player.reset()
            found = np.stack([player.step(row) for row in observations])
            np.testing.assert_allclose(found, whole, atol=1e-5, err_msg=form)
    policy.save(tmp_path / "p.safetensors")
    loaded = rtd.load_policy(tmp_path / "p.safetensors")
    assert loaded.acting == "carry"
    np.testing.assert_array_equal(_actions(loaded, observations), _actions(policy, observations))


@pytest.mark.parametrize(
    ("agent", "acting"),
    [("td3", "window"), *itertools.product(("lstm-td3", "lstm-td3-1ha1hc"), ("window", "carry"))],
)
def test_every_form_normalises_as_the_policy_does(tmp_path, env, observations, agent, acting):
    normaliser = Normaliser(jnp.float32([1e3, -2e-3]), jnp.float32([1e-2, 1e3]))
    raw = observations / np.float32([1e-2, 1e3]) + np.float32([1e3, -2e-3])
    raw[3] = 1e6  # beyond the limit
    plain = random_policy(agent, env, scale=2.0, acting=acting)
    policy = plain.replace(normaliser=normaliser)
    want = _actions(policy, raw)
    read = np.clip((raw - np.asarray(normaliser.mean)) * np.asarray(normaliser.scale), -10, 10)
    np.testing.assert_allclose(want, _actions(plain, read), atol=1e-5)
    for form in FORMATS:
        path = tmp_path / ("p" + FORMATS[form][0])
        policy.export(path, format=form)
        player = PLAYERS[form](path)
        player.reset()
        found = np.stack([player.step(row) for row in raw])
        np.testing.assert_allclose(found, want, atol=1e-5, err_msg=form)
    policy.save(tmp_path / "p.safetensors")
    loaded = rtd.load_policy(tmp_path / "p.safetensors")
    jax.tree.map(np.testing.assert_array_equal, loaded.normaliser, normaliser)
    np.testing.assert_allclose(_actions(loaded, raw), want, atol=1e-6)


def test_its_state_does_not_grow_with_the_history(env):
    sizes = {
        length: [
            leaf.shape
            for leaf in jax.tree.leaves(
                random_policy("lstm-td3", env, length=length, acting="carry").init()
            )
        ]
        for length in (1, 50)
    }
    assert sizes[1] == sizes[50]


def test_a_training_with_segments_gives_such_a_policy(env, tmp_path):
    config = rtd.Config(
        algorithm="h-td3",
        replay="segments",
        history_length=2,
        segment_length=4,
        total_steps=60,
        hidden_size=8,
        batch_size=8,
        learning_starts=20,
        eval_every=30,
        eval_episodes=1,
    )
    run = rtd.train(env, config, seeds=[0], progress=False)
    policy = run.policy(0)
    assert policy.acting == "carry" and np.isfinite(run.returns).all()
    one_by_one = rtd.train(env, config, seeds=[0, 1], progress=False, strategy="vmap")
    np.testing.assert_allclose(one_by_one.returns[0], run.returns[0], rtol=1e-3)
