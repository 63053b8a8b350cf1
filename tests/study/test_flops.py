"""Compares the operations that `update_flops` counts with XLA's count."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import pytest

from rtd3jax.agents.agent import make_part
from rtd3jax.agents.hyperparameters import Hyperparameters
from rtd3jax.agents.learners import td3
from rtd3jax.agents.learners.base import Networks
from rtd3jax.agents.memory import lstm
from rtd3jax.agents.replay import empty_replay, gather, gather_segments
from rtd3jax.config import Config
from rtd3jax.registries import AGENTS
from rtd3jax.study.flops import update_flops


def _unrolled(f, carry, xs, reverse=False):
    """`lax.scan` written out, because XLA counts a loop's body once."""
    steps = range(jax.tree.leaves(xs)[0].shape[0])
    ys = {}
    for t in reversed(steps) if reverse else steps:
        carry, ys[t] = f(carry, jax.tree.map(lambda x, t=t: x[t], xs))
    return carry, jax.tree.map(lambda *rows: jnp.stack(rows), *(ys[t] for t in steps))


def _mapped(f, xs):
    """`lax.map` written out, likewise."""
    return _unrolled(lambda _, x: (None, f(x)), None, xs)[1]


def _counted(algorithm, length, width, batch_size, segments=None):
    """XLA's count for a step's updates: products of any size, and elementwise operations."""
    variant = AGENTS[algorithm]
    networks = Networks(*(make_part(variant, r, "lstm", 2, 2, width) for r in ("actor", "critic")))
    numbers = {f.name: jnp.float32(0.1) for f in dataclasses.fields(Hyperparameters)}
    numbers = Hyperparameters(**numbers | {"history_length": jnp.int32(length)})

    def inputs():
        carry = lstm.zero_carry(1, width) if variant.critic_reads_carries else None
        replay = empty_replay(200, 2, 2, carry)
        if segments is None:
            rows = jnp.zeros((batch_size,), jnp.int32)
            batch = gather(replay, rows, jnp.int32(5), length, length)
        else:
            steps, burn_in_gradient = segments
            rows = jnp.zeros((batch_size // steps,), jnp.int32)
            batch = gather_segments(
                replay, rows, jnp.int32(9), length, length, steps, burn_in_gradient
            )
        return td3.TD3().init(jax.random.key(0), networks), batch

    def critics(learner, batch):
        key = jax.random.key(0)
        return td3.update_critics(networks, learner, batch, key, numbers, jnp.asarray(False))

    def actor(learner, batch):
        key = jax.random.key(0)
        return td3.update_actor_and_targets(
            networks, learner, batch, key, numbers, jnp.asarray(False)
        )

    count = [
        jax.jit(update).lower(*jax.eval_shape(inputs)).cost_analysis()["flops"]
        for update in (critics, actor)
    ]
    return count[0] + count[1] / Config.policy_delay


@pytest.mark.parametrize(
    "algorithm, segments",
    [
        *((name, None) for name in ("td3", "lstm-td3", "lstm-td3-1ha1hc", "h-td3")),
        ("lstm-td3-1ha1hc", (5, False)),
        *(
            pytest.param(name, segments, marks=pytest.mark.slow)
            for name, segments in (
                ("lstm-td3-no-action", None),
                ("lstm-td3-1ha2hc", None),
                ("lstm-td3", (5, True)),
                ("h-td3", (5, True)),
            )
        ),
    ],
)
def test_operations_are_those_that_xla_counts(algorithm, segments, monkeypatch):
    monkeypatch.setattr(lstm, "lax", types.SimpleNamespace(**{**vars(jax.lax), "scan": _unrolled}))
    monkeypatch.setattr(td3, "lax", types.SimpleNamespace(**{**vars(jax.lax), "map": _mapped}))
    length = 0 if algorithm == "td3" else 2
    # Left out: narrow products and activations, which grow with H alone, and Adam's and Polyak's
    # arithmetic, which does not grow with the batch.
    fields = {}
    if segments is not None:
        fields = dict(replay="segments", segment_length=segments[0], burn_in_gradient=segments[1])
    for width, batch_size, left_out in ((128, 100, 0.07), (1024, 1000, 0.01)):
        config = Config(
            algorithm,
            length or None,
            hidden_size=width,
            batch_size=batch_size,
            **fields,
        )
        ratio = _counted(algorithm, length, width, batch_size, segments) / update_flops(config)
        # What a segment's first token sends back to the carry before it is computed in a loop, and
        # left out where the loop is written out.
        least = 1.0 if segments is None else 0.985
        assert least <= ratio <= 1.0 + left_out, (width, ratio)
