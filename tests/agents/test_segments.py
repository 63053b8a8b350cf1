"""Compares segments with windows: targets, losses and gradients of every agent."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_td3 import _numbers

from rtd3jax.agents.agent import make_part
from rtd3jax.agents.history import Steps
from rtd3jax.agents.learners import td3
from rtd3jax.agents.learners.base import Networks
from rtd3jax.agents.networks import carry_before, segment_carries
from rtd3jax.agents.replay import (
    Transition,
    Truth,
    empty_replay,
    gather,
    gather_segments,
    put_carries,
    put_transitions,
    sample_segments,
)
from rtd3jax.registries import AGENTS

OBSERVATION, ACTION, WIDTH = 3, 2, 8
LENGTHS = (5, 1, 6, 2, 4, 6, 3, 5, 6)
"""Of the episodes; the last one has not ended."""
CAPACITY, LONGEST = 23, 6


@pytest.fixture(scope="module", params=["lstm", "gru", "min-gru"])
def memory(request):
    return request.param


def _ring(agent, memory="lstm"):
    """A ring that has wrapped, of random rows and carries; and the number of rows written."""
    actor = make_part(AGENTS[agent], "actor", memory, OBSERVATION, ACTION, WIDTH)
    carry = actor.zero_carry(1) if AGENTS[agent].critic_reads_carries else None
    size = OBSERVATION if AGENTS[agent].reads_truth else 0
    replay, number = empty_replay(CAPACITY, OBSERVATION, ACTION, carry, 1, size), 0
    random = np.random.default_rng(0)

    def draw(*shape):
        return jnp.asarray(random.uniform(-1, 1, shape), jnp.float32)

    put, put_next = jax.jit(put_transitions), jax.jit(put_carries)
    for episode, length in enumerate(LENGTHS):
        observation, previous = draw(OBSERVATION), jnp.zeros(ACTION)
        for episode_step in range(length):
            action, after = draw(ACTION), draw(OBSERVATION)
            last = episode_step == length - 1
            row = Transition(
                step=Steps(observation, previous, action),
                reward=draw(),
                next_observation=after,
                terminated=jnp.asarray(last and episode % 2 == 0),
                episode_step=jnp.int32(episode_step),
                truth=Truth(draw(OBSERVATION), draw(OBSERVATION)) if size else None,
            )
            one = jax.tree.map(lambda leaf: leaf[None], row)
            replay = put(replay, jnp.int32(number), one)
            if carry is not None:
                own = jax.tree.map(lambda leaf: draw(*leaf.shape[1:])[None], carry)
                replay = put_next(replay, jnp.int32(number + 1), own)
            observation, previous, number = after, action, number + 1
    return replay, number


def _networks(agent, memory="lstm"):
    networks = Networks(
        *(
            make_part(AGENTS[agent], role, memory, OBSERVATION, ACTION, WIDTH)
            for role in ("actor", "critic")
        )
    )
    online, other = (td3.TD3().init(jax.random.key(k), networks) for k in range(2))
    return networks, online.replace(target_actor=other.actor, target_critics=other.critics)


def _learned(networks, state, batch):
    """The target, and losses with their gradients."""
    numbers = _numbers(target_noise=0.0)
    y = td3.target(networks, state, batch, jax.random.key(0), numbers)
    critic = jax.value_and_grad(td3.critic_loss, has_aux=True)(
        state.critics[0], networks.critic, batch, y
    )
    actor = jax.value_and_grad(td3.actor_loss, has_aux=True)(
        state.actor, state.critics[0], networks, batch, jax.random.key(0), jnp.float32(0.0)
    )
    return y, critic, actor


OFTEN = ("lstm-td3", "lstm-td3-1ha1hc", "h-td3")


@pytest.mark.parametrize(
    "agent",
    [
        pytest.param(name, marks=[] if name in OFTEN else [pytest.mark.slow])
        for name in AGENTS
        if AGENTS[name].has_window
    ],
)
def test_with_whole_episodes_they_learn_what_windows_do(agent):
    replay, count = _ring(agent)
    networks, state = _networks(agent)
    length, oldest = 4, count - CAPACITY
    first = jnp.asarray([oldest, oldest + 1, *range(oldest + 2, count - length + 1, 3)], jnp.int32)
    segments = gather_segments(
        replay, first, jnp.int32(count), LONGEST, LONGEST, length, burn_in_gradient=True
    )
    number = (first[None, :] + jnp.arange(length)[:, None]).reshape(-1)
    windows = gather(replay, number, jnp.int32(count), LONGEST, LONGEST)
    for name in ("action", "reward", "terminated", "carry", "next_carry"):
        np.testing.assert_array_equal(
            *(np.asarray(jax.tree.leaves(getattr(b, name))) for b in (segments, windows))
        )
    learn = jax.jit(functools.partial(_learned, networks, state))
    for got, want in zip(
        jax.tree.leaves(learn(segments)), jax.tree.leaves(learn(windows)), strict=True
    ):
        np.testing.assert_allclose(got, want, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("own", [2, 3])
def test_every_step_has_the_burn_in_and_what_lies_between(own, memory):
    """``own`` is a history length below that of the arrays."""
    agent, length, tokens = "lstm-td3-1ha1hc", 4, 3
    replay, count = _ring(agent, memory)
    networks, state = _networks(agent, memory)
    first = jnp.arange(count - CAPACITY, count - length + 1, dtype=jnp.int32)
    batch = gather_segments(
        replay, first, jnp.int32(count), tokens, jnp.int32(own), length, burn_in_gradient=True
    )
    critic = networks.critic, state.critics[0]
    gathered = jax.jit(gather, static_argnums=3)
    carry = jax.jit(carry_before, static_argnums=0)
    before, after = (
        [np.asarray(leaf).reshape(length, len(first), -1) for leaf in jax.tree.leaves(carries)]
        for carries in segment_carries(*critic, batch.window)
    )
    for j in range(length):
        wider = gathered(replay, first + j, jnp.int32(count), tokens + length, own + j)
        for got, window in ((before, wider.window), (after, None)):
            if window is None:
                following = gathered(replay, first + j, jnp.int32(count), 9, own + j + 1)
                window = following.next_window
            want = jax.tree.leaves(carry(*critic, window))
            for leaf, expected in zip(got, want, strict=True):
                np.testing.assert_allclose(leaf[j], expected, atol=1e-6)


def test_the_burn_in_gradient_is_a_choice():
    agent, length, tokens = "lstm-td3-1ha1hc", 2, 3
    replay, count = _ring(agent)
    networks, state = _networks(agent)
    first = jnp.asarray([count - 4, count - 3], jnp.int32)  # within the last episode

    def gradient(burn_in_gradient):
        batch = gather_segments(
            replay, first, jnp.int32(count), tokens, tokens, length, burn_in_gradient
        )
        y = jnp.zeros(batch.reward.shape)
        loss = jax.value_and_grad(td3.critic_loss, has_aux=True)
        return batch, loss(state.critics[0], networks.critic, batch, y)

    (_, (through, with_it)), (batch, (cut, without)) = gradient(True), gradient(False)
    np.testing.assert_allclose(through[0], cut[0], rtol=1e-6)
    differs = jax.tree.map(lambda a, b: float(abs(a - b).max()), with_it, without)
    assert differs["memory"]["recurrent_kernel"] > 1e-4

    def by_hand(params):
        """The same with plain steps: what the burn-in's carries depend on is held."""
        critic, steps = networks.critic, batch.window.steps
        tokens_of = jnp.concatenate((steps.observation, steps.action), axis=-1)
        held = jax.lax.stop_gradient(params)
        carry, errors = critic.zero_carry(len(first)), []
        for k, token in enumerate(tokens_of):
            carry = jax.tree.map(
                lambda leaf, k=k: jnp.where(batch.window.starts[k][:, None], 0.0, leaf), carry
            )
            carry = critic.apply(
                {"params": held if k < tokens else params},
                carry,
                token,
                method=lambda m, c, x: m.memory.step(c, m.encode(x[None])[0]),
            )
            if k >= tokens:
                feature = carry.hidden
                errors.append(
                    critic.apply({"params": params}, feature, None, method="from_features")[:, 0]
                )
        return jnp.mean(jnp.stack(errors) ** 2)

    expected = jax.grad(by_hand)(state.critics[0])
    for got, want in zip(jax.tree.leaves(without), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-6)


def test_draws_cover_all_that_is_kept_and_nothing_else():
    replay, count = _ring("lstm-td3")
    draws = jax.jit(
        lambda key: sample_segments(replay, key, jnp.int32(count), 400, 2, 2, 4, True).reward
    )(jax.random.key(0))
    kept = np.asarray(replay.transitions.reward)
    assert set(np.asarray(draws).tolist()) == set(kept.tolist())
    few = sample_segments(replay, jax.random.key(1), jnp.int32(4), 8, 2, 2, 4, True)
    np.testing.assert_array_equal(few.reward, np.repeat(kept[:4], 2))
