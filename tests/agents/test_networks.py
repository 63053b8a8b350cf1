"""Compares the six agents' networks with the paper's tables and a separate numpy version."""

import functools
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtd3jax.agents.agent import count_parameters, make_part
from rtd3jax.agents.history import Steps, Window
from rtd3jax.agents.networks import (
    NetworkSpec,
    apply_network,
    carry_before,
    init_network,
    make_network,
)
from rtd3jax.agents.variants import ALGORITHMS
from rtd3jax.errors import UserError
from rtd3jax.registries import AGENTS

L, B, O, A, H = 3, 5, 3, 2, 8  # noqa: E741


@pytest.mark.parametrize(
    ("algorithm", "actor", "critic"),
    [
        ("lstm-td3", 166_273, 166_401),
        ("lstm-td3-1ha1hc", 149_377, 149_377),
        ("lstm-td3-1ha2hc", 149_377, 166_017),
        ("h-td3", 149_377, 149_377),
        ("td3", 17_153, 17_281),
    ],
)
def test_parameter_counts_are_the_papers(algorithm, actor, critic):
    assert count_parameters(algorithm, obs_dim=3, act_dim=1) == {"actor": actor, "critic": critic}


def test_unknown_algorithm_names_the_nearest():
    with pytest.raises(UserError, match="did you mean 'h-td3'"):
        count_parameters("h-td", 3, 1)


def _window(key, length):
    keys = jax.random.split(key, 5)
    past = Steps(
        jax.random.normal(keys[0], (L, B, O)),
        jax.random.normal(keys[1], (L, B, A)),
        jax.random.normal(keys[2], (L, B, A)),
    )
    return Window(
        past,
        jnp.asarray(length, jnp.int32),
        jax.random.normal(keys[3], (B, O)),
        jax.random.normal(keys[4], (B, A)),
    )


def _np_lstm(params, tokens, h, c):
    def sigmoid(x):
        return 1 / (1 + np.exp(-x))

    for x in tokens:
        gates = x @ params["input_kernel"] + params["input_bias"]
        gates = gates + h @ params["recurrent_kernel"] + params["recurrent_bias"]
        i, f, g, o = (gates[k * H : (k + 1) * H] for k in range(4))
        c = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
        h = sigmoid(o) * np.tanh(c)
    return h, c


def _np_network(p, name, role, w, b, action, stored):
    """One sample of one network, agent by agent, as the paper says it in words."""

    def linear(q, x):
        return x @ q["kernel"] + q["bias"]

    def relu(x):
        return np.maximum(x, 0)

    n = int(w.length[b])
    past = range(L - n, L)
    obs, prev, act = (w.past.observation, w.past.previous_action, w.past.action)
    now_o, now_p, now_a = w.observation[b], w.previous_action[b], action[b]
    cat, zero = np.concatenate, np.zeros(H, np.float32)

    def memory(tokens, start=(zero, zero)):
        return _np_lstm(p["memory"], [relu(linear(p["encoder"], x)) for x in tokens], *start)[0]

    oa = [cat([obs[k, b], act[k, b]]) for k in past]
    op = [cat([obs[k, b], prev[k, b]]) for k in past] + [cat([now_o, now_p])]
    now_oa = cat([now_o, now_a])
    current = (
        relu(linear(p["current"], now_o if role == "actor" else now_oa))
        if name
        in (
            "td3",
            "lstm-td3",
            "lstm-td3-no-action",
        )
        else None
    )
    if name == "td3":
        features = current
    elif name == "lstm-td3":
        features = cat([memory(oa), current])
    elif name == "lstm-td3-no-action":
        features = cat([memory([obs[k, b] for k in past]), current])
    elif role == "actor":
        features = memory(op)
    elif name == "lstm-td3-1ha1hc":
        features = memory([*oa, now_oa])
    elif name == "lstm-td3-1ha2hc":
        features = cat([memory(op), relu(linear(p["current"], now_a))])
    else:
        features = memory([now_oa], (stored.hidden[b], stored.cell[b]))
    return linear(p["output"], relu(linear(p["head"], features)))


@pytest.mark.parametrize("role", ["actor", "critic"])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_forward_pass_equals_numpy(algorithm, role):
    network = make_part(AGENTS[algorithm], role, "lstm", O, A, H)
    params = init_network(jax.random.key(1), network)
    window = _window(jax.random.key(2), [0, 1, 2, 3, 3])
    action = jax.random.normal(jax.random.key(3), (B, A))
    stored = None
    if network.reads.carry_from_replay:
        actor = make_part(AGENTS[algorithm], "actor", "lstm", O, A, H)
        stored = carry_before(actor, init_network(jax.random.key(4), actor), window)
    ours = apply_network(network, params, window, action, stored)
    numpy = jax.tree.map(np.asarray, (params, window, action, stored))
    theirs = [_np_network(numpy[0], algorithm, role, numpy[1], b, *numpy[2:]) for b in range(B)]
    np.testing.assert_allclose(ours, np.stack(theirs), atol=1e-5)


def test_initial_weights_are_uniform_in_the_stated_bounds():
    network = make_part(AGENTS["lstm-td3-1ha1hc"], "actor", "lstm", 3, 1, 128)
    params = init_network(jax.random.key(0), network)
    for name, fan_in in (("encoder", 4), ("head", 128), ("output", 128)):
        kernel = np.asarray(params[name]["kernel"]) * fan_in**0.5
        assert np.abs(kernel).max() <= 1 and abs(kernel).mean() == pytest.approx(0.5, abs=0.07)
    for leaf in params["memory"].values():
        scaled = np.abs(leaf) * 128**0.5
        assert scaled.max() <= 1 and scaled.mean() == pytest.approx(0.5, abs=0.03)


class _Encoder(nn.Module):
    """A layer, and what ``after`` makes of its output."""

    inputs: int
    outputs: int
    after: Callable = lambda x: x

    @nn.compact
    def __call__(self, x):
        return self.after(nn.Dense(self.outputs)(x))


@pytest.mark.parametrize(
    ("after", "message"),
    [
        (lambda x: nn.BatchNorm(use_running_average=True)(x), "batch_stats.*only use parameters"),
        (lambda x: nn.BatchNorm(use_running_average=False)(x), "batch_stats.*only use parameters"),
        (lambda x: nn.Dropout(0.5, deterministic=False)(x), "dropout.*or random numbers"),
        (lambda x: x[:, :3], r"must return float32 \[batch, 8\], not float32\[2, 3\]"),
        (lambda x: (x, x), r"must return float32 \[batch, 8\], not tuple\[\] for"),
        (lambda x: x.nothing, "encoder _Encoder failed: .*nothing.*$"),
    ],
)
def test_an_encoder_that_cannot_be_applied_in_training_is_one_line(after, message):
    def make(after):
        return make_network(
            NetworkSpec(current=("observation",)),
            "lstm",
            {"observation": O},
            H,
            A,
            encoder=functools.partial(_Encoder, after=after),
        )

    make(nn.tanh)
    with pytest.raises(UserError, match=message):
        make(after)
