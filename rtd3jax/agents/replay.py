"""A lane's replay: a ring of transitions, and batches of windows cut from it.

Every environment step writes one row, so a row's number is the lane's step and the ring needs no
counter of its own. Shapes: ``C`` capacity, ``B`` batch, ``H`` width.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.agents.lstm import Carry
from rtd3jax.agents.windows import (
    Steps,
    Window,
    empty_steps,
    next_window,
    past_tokens,
    put_row,
    put_step,
)


@struct.dataclass
class Transition:
    """One environment step. Leaves: [C, ...] in the ring, [...] as a row.

    Attributes:
        step: what the agent saw, what it had done before, and what it did.
        reward: [].
        next_observation: [O]; at an episode's end the final observation, never the next episode's
            first.
        terminated: bool []; stops bootstrapping. A time limit is not a termination.
        age: int32 [], steps of the same episode before this one; bounds the window.
    """

    step: Steps
    reward: jax.Array
    next_observation: jax.Array
    terminated: jax.Array
    age: jax.Array


@struct.dataclass
class Replay:
    """The ring.

    Attributes:
        transitions: leaves [C, ...].
        carries: h-td3 only, leaves [C + 1, H]: slot n % (C + 1) holds the behaviour actor's carry
            before step n's current token, that is the carry *of* row n and the *next* carry of row
            n - 1. An episode's first step has no past, so its carry is zero and its slot is free
            for the carry that belongs to the final observation of the episode before.
    """

    transitions: Transition
    carries: Carry | None


@struct.dataclass
class Batch:
    """Sampled transitions, leaves [B, ...]; ``carry`` and ``next_carry`` for h-td3 only."""

    window: Window
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    next_window: Window
    carry: Carry | None
    next_carry: Carry | None


def empty_replay(
    capacity: int, observation_size: int, action_size: int, carry_width: int | None
) -> Replay:
    """A ring of ``capacity`` rows; with carries of ``carry_width`` unless that is None."""
    transitions = Transition(
        step=empty_steps(capacity, observation_size, action_size),
        reward=jnp.zeros((capacity,), jnp.float32),
        next_observation=jnp.zeros((capacity, observation_size), jnp.float32),
        terminated=jnp.zeros((capacity,), bool),
        age=jnp.zeros((capacity,), jnp.int32),
    )
    carries = None
    if carry_width is not None:
        carries = Carry(*(jnp.zeros((capacity + 1, carry_width), jnp.float32) for _ in range(2)))
    return Replay(transitions, carries)


def put_transition(replay: Replay, number: jax.Array, row: Transition) -> Replay:
    """The ring after step ``number`` (int32 [])."""
    kept = replay.transitions
    slot = number % kept.reward.shape[0]
    return dataclasses.replace(
        replay,
        transitions=Transition(
            step=put_step(kept.step, number, row.step),
            reward=put_row(kept.reward, slot, row.reward),
            next_observation=put_row(kept.next_observation, slot, row.next_observation),
            terminated=put_row(kept.terminated, slot, row.terminated),
            age=put_row(kept.age, slot, row.age),
        ),
    )


def put_carry(replay: Replay, number: jax.Array, carry: Carry) -> Replay:
    """The ring with the behaviour actor's carry (leaves [H]) before step ``number``."""
    assert replay.carries is not None
    slot = number % replay.carries.hidden.shape[0]
    carries = Carry(
        *(put_row(kept, slot, row) for kept, row in zip(replay.carries, carry, strict=True))
    )
    return dataclasses.replace(replay, carries=carries)


def sample(
    replay: Replay,
    key: jax.Array,
    count: jax.Array,
    batch_size: int,
    tokens: int,
    history_length: jax.Array | int,
) -> Batch:
    """Uniform draws, with replacement, from the rows kept; the cost does not depend on C.

    Args:
        replay: the ring.
        key: consumed here.
        count: int32 [], steps written so far, at least 1.
        batch_size: B.
        tokens: L, past tokens in a window.
        history_length: l <= L, past tokens that may be read.
    """
    capacity = replay.transitions.reward.shape[0]
    oldest = jnp.maximum(count - capacity, 0)
    number = jax.random.randint(key, (batch_size,), oldest, count, jnp.int32)
    return gather(replay, number, count, tokens, history_length)


def gather(
    replay: Replay,
    number: jax.Array,
    count: jax.Array,
    tokens: int,
    history_length: jax.Array | int,
) -> Batch:
    """The batch of the rows with these numbers (int32 [B], all of them kept); see `sample`."""
    kept = replay.transitions
    slot = number % kept.reward.shape[0]
    age = kept.age[slot]
    past, length = past_tokens(kept.step, number, age, count, tokens)
    window = Window(
        past=past,
        length=jnp.minimum(length, history_length).astype(jnp.int32),
        observation=kept.step.observation[slot],
        previous_action=kept.step.previous_action[slot],
    )
    action = kept.step.action[slot]
    carry = next_carry = None
    if replay.carries is not None:
        carry = _carry_at(replay.carries, number)
        first = (age == 0)[:, None]
        carry = Carry(*(jnp.where(first, jnp.zeros_like(part), part) for part in carry))
        next_carry = _carry_at(replay.carries, number + 1)
    return Batch(
        window=window,
        action=action,
        reward=kept.reward[slot],
        terminated=kept.terminated[slot],
        next_window=next_window(window, action, kept.next_observation[slot], history_length),
        carry=carry,
        next_carry=next_carry,
    )


def _carry_at(carries: Carry, number: jax.Array) -> Carry:
    slot = number % carries.hidden.shape[0]
    return Carry(*(kept[slot].astype(jnp.float32) for kept in carries))
