"""A lane's replay: a ring buffer of transitions, from which batches of windows are read.

Every environment step writes one row, so the lane's step determines the number of the row, and the
ring needs no counter: of E environments, environment e writes row ``s E + e`` at the lane's step s.
If the critics of an agent (h-td3) or its segments start from the behaviour actor's carries, the
ring also stores these carries. This module ensures the order of reads and writes that this needs.
Shapes: ``C`` capacity, ``B`` batch, ``H`` width, ``E`` environments.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.agents.history import (
    History,
    Segment,
    Steps,
    Window,
    empty_steps,
    flat,
    next_window,
    put_rows,
    segment_at,
    window_at,
)
from rtd3jax.agents.memory.base import Carry
from rtd3jax.agents.rows import where_rows


@struct.dataclass
class Transition:
    """One environment step. Leaves are [C, ...] in the ring, and [...] as a row.

    Attributes:
        step: the observation, the previous action, and the action.
        reward: [].
        next_observation: [O]; at the end of an episode, the final observation of this episode.
        terminated: bool []; no bootstrapping after it. A time limit is not a termination.
        episode_step: int32 [], number of earlier steps of the same episode; it limits the window.
        truth: the undisturbed observations, for critics that read them; else None.
    """

    step: Steps
    reward: jax.Array
    next_observation: jax.Array
    terminated: jax.Array
    episode_step: jax.Array
    truth: "Truth | None" = None


@struct.dataclass
class Truth:
    """Undisturbed observations of a transition.

    Attributes:
        observation: [S], at the step.
        next_observation: [S], after it; at the end of an episode, of the final observation.
    """

    observation: jax.Array
    next_observation: jax.Array


@struct.dataclass
class Replay:
    """The ring buffer.

    Attributes:
        transitions: leaves [C, ...].
        carries: None, or leaves [C + E, ...]: slot n % (C + E) holds the behaviour actor's carry
            before the token of step n. It is the carry of row n, and the next carry of row n - E.
            The carry of an episode's first step is zero and needs no slot, so the slot holds the
            carry before the final observation of the previous episode.
        environments: E; it divides C.
    """

    transitions: Transition
    carries: Carry | None
    environments: int = struct.field(pytree_node=False, default=1)


@struct.dataclass
class Batch:
    """Sampled transitions, leaves [B, ...]; ``carry`` and ``next_carry`` for h-td3 only.

    ``window`` and ``next_window`` are windows, or segments, in which transitions share tokens;
    `rtd3jax.agents.networks.apply_network` takes both.
    """

    window: History
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    next_window: History
    carry: Carry | None
    next_carry: Carry | None

    @property
    def recorded_action(self) -> jax.Array | None:
        """``action`` for `apply_network`: None with a segment, whose tokens contain it."""
        return None if isinstance(self.window, Segment) and self.carry is None else self.action


def empty_replay(
    capacity: int,
    observation_size: int,
    action_size: int,
    carry: Carry | None,
    environments: int = 1,
    true_observation_size: int = 0,
) -> Replay:
    """A ring of ``capacity`` rows; it stores carries like ``carry`` [1, ...] unless None.

    It stores undisturbed observations of ``true_observation_size`` elements, unless this is 0.
    """
    size = true_observation_size
    truths = (jnp.zeros((capacity, size), jnp.float32) for _ in range(2))
    transitions = Transition(
        step=empty_steps(capacity, observation_size, action_size),
        reward=jnp.zeros((capacity,), jnp.float32),
        next_observation=jnp.zeros((capacity, observation_size), jnp.float32),
        terminated=jnp.zeros((capacity,), bool),
        episode_step=jnp.zeros((capacity,), jnp.int32),
        truth=Truth(*truths) if size else None,
    )
    carries = jax.tree.map(
        lambda leaf: jnp.zeros((capacity + environments, *leaf.shape[1:]), jnp.float32), carry
    )
    return Replay(transitions, carries, environments)


def present_window(
    replay: Replay,
    step: jax.Array,
    episode_step: jax.Array,
    observation: jax.Array,
    previous_action: jax.Array,
    window_tokens: int,
    history_length: jax.Array | int,
) -> Window:
    """The E windows of the lane's step ``step`` (int32 []), which is not in the ring yet.

    Args:
        replay: the ring, with all earlier steps.
        step: the number of the step.
        episode_step: int32 [E], number of earlier steps of the same episode.
        observation: [E, O], the observations of the step.
        previous_action: [E, A], the previous actions.
        window_tokens: L, past tokens in the window's arrays.
        history_length: l <= L, past tokens that may be read.
    """
    count = step * replay.environments
    return window_at(
        replay.transitions.step,
        count + jnp.arange(replay.environments, dtype=jnp.int32),
        episode_step,
        count,
        window_tokens,
        history_length,
        observation,
        previous_action,
        replay.environments,
    )


def put_transitions(replay: Replay, first: jax.Array, rows: Transition) -> Replay:
    """The ring after writing ``rows`` of E environments (leaves [E, ...]) from ``first`` on."""
    kept = replay.transitions
    slot = first % kept.reward.shape[0]
    written = jax.tree.map(lambda ring, new: put_rows(ring, slot, new), kept, rows)
    return dataclasses.replace(replay, transitions=written)


def put_carries(replay: Replay, first: jax.Array, rows: Carry) -> Replay:
    """The ring after writing the carries (leaves [E, ...]) of the steps from ``first`` on."""
    slot = _carry_slot(replay.carries, first)
    carries = jax.tree.map(lambda kept, new: put_rows(kept, slot, new), replay.carries, rows)
    return dataclasses.replace(replay, carries=carries)


def keep_acting_carry(
    replay: Replay, step: jax.Array, episode_step: jax.Array, carry: Carry | None
) -> Replay:
    """Store the carries (leaves [E, ...]) with which step ``step`` acts, before its updates.

    The carry of an episode's first step is not stored: its slot holds the carry before the final
    observation of the previous episode.
    """
    if replay.carries is None:
        return replay
    first = step * replay.environments
    slot = _carry_slot(replay.carries, first)

    def rows(kept: jax.Array, new: jax.Array) -> jax.Array:
        there = jax.lax.dynamic_slice_in_dim(kept, slot, replay.environments, axis=0)
        return where_rows(episode_step == 0, there, new)

    return put_carries(replay, first, jax.tree.map(rows, replay.carries, carry))


def store(
    replay: Replay,
    step: jax.Array,
    rows: Transition,
    done: jax.Array,
    final_carry: Callable[[], Carry],
    never: jax.Array,
) -> Replay:
    """Write step ``step`` into the ring, after the updates of this step have read the ring.

    Args:
        replay: the ring.
        step: int32 [].
        rows: the transitions of the E environments, leaves [E, ...].
        done: bool [E], whether the step ended an episode.
        final_carry: returns the behaviour actor's carries, leaves [E, ...], before the final
            observations; only called if the ring stores carries.
        never: bool [], false, computed from values that the updates read; see `_after`.
    """
    first = _after(step, never) * replay.environments
    replay = put_transitions(replay, first, rows)
    if replay.carries is None:
        return replay
    # Within an episode, the carry of the next step overwrites this slot. Under vmap, lanes compute
    # the final carries at every step, which is one more pass over windows than the updates need.
    carry = jax.lax.cond(
        jnp.any(done),
        final_carry,
        lambda: jax.tree.map(
            lambda kept: jnp.zeros((replay.environments, *kept.shape[1:]), kept.dtype),
            replay.carries,
        ),
    )
    return put_carries(replay, first + replay.environments, carry)


@jax.custom_batching.custom_vmap
def _after(step_number: jax.Array, never: jax.Array) -> jax.Array:
    """``step_number``, with a data dependency on ``never``, which is always false.

    A write at this number then happens after the reads from which ``never`` was computed. Without
    this order, XLA copies the whole ring at every step. An optimization barrier does not help:
    XLA removes barriers before it decides on copies.
    """
    return step_number + never.astype(step_number.dtype)


@_after.def_vmap
def _after_of_lanes(axis_size, batched, step_number, never):
    # All lanes use the same number, so that the write does not become a scatter.
    assert not batched[0]
    return _after(step_number, jnp.any(never)), False


def sample(
    replay: Replay,
    key: jax.Array,
    count: jax.Array,
    batch_size: int,
    window_tokens: int,
    history_length: jax.Array | int,
) -> Batch:
    """A batch drawn uniformly, with replacement; the time does not depend on C.

    Args:
        replay: the ring.
        key: consumed here.
        count: int32 [], number of steps written so far, at least 1.
        batch_size: B.
        window_tokens: L, past tokens in a window.
        history_length: l <= L, past tokens that may be read.
    """
    capacity = replay.transitions.reward.shape[0]
    oldest = jnp.maximum(count - capacity, 0)
    step_number = jax.random.randint(key, (batch_size,), oldest, count, jnp.int32)
    return gather(replay, step_number, count, window_tokens, history_length)


def gather(
    replay: Replay,
    step_number: jax.Array,
    count: jax.Array,
    window_tokens: int,
    history_length: jax.Array | int,
) -> Batch:
    """The batch of the rows with these numbers (int32 [B]), which are in the ring; see `sample`."""
    kept = replay.transitions
    slot = step_number % kept.reward.shape[0]
    episode_step = kept.episode_step[slot]
    window = window_at(
        kept.step,
        step_number,
        episode_step,
        count,
        window_tokens,
        history_length,
        kept.step.observation[slot],
        kept.step.previous_action[slot],
        replay.environments,
    )
    action = kept.step.action[slot]
    carry, next_carry = _stored_carries(replay, step_number, episode_step)
    batch = Batch(
        window=window,
        action=action,
        reward=kept.reward[slot],
        terminated=kept.terminated[slot],
        next_window=next_window(window, action, kept.next_observation[slot], history_length),
        carry=carry,
        next_carry=next_carry,
    )
    return _with_truth(batch, kept.truth, slot)


def _with_truth(batch: Batch, truth: Truth | None, slot: jax.Array) -> Batch:
    """``batch``, with the undisturbed observations in ``slot`` [B], if the ring stores them."""
    if truth is None:
        return batch
    rows = jax.tree.map(lambda kept: kept[slot], truth)
    return dataclasses.replace(
        batch,
        window=dataclasses.replace(batch.window, true_observation=rows.observation),
        next_window=dataclasses.replace(batch.next_window, true_observation=rows.next_observation),
    )


def sample_segments(
    replay: Replay,
    key: jax.Array,
    count: jax.Array,
    batch_size: int,
    window_tokens: int,
    history_length: jax.Array | int,
    length: int,
    burn_in_gradient: bool,
    *,
    critic_reads_carries: bool = True,
    actor_reads_carries: bool = False,
) -> Batch:
    """As `sample`, but B / m segments of m consecutive steps; their first steps are uniform.

    Args:
        replay: the ring.
        key: consumed here.
        count: int32 [], number of steps written so far, at least m.
        batch_size: B, a multiple of m.
        window_tokens: L, steps of the burn-in.
        history_length: l <= L, steps of the burn-in that may be read.
        length: m.
        burn_in_gradient: whether gradients flow into the burn-in.
        critic_reads_carries: whether the batch holds the ring's carries, if there are any, for the
            critic.
        actor_reads_carries: whether the segments begin with the ring's carries, for the actor.
    """
    oldest = jnp.maximum(count - replay.transitions.reward.shape[0], 0)
    last = count - (length - 1) * replay.environments
    first = jax.random.randint(key, (batch_size // length,), oldest, last, jnp.int32)
    return gather_segments(
        replay,
        first,
        count,
        window_tokens,
        history_length,
        length,
        burn_in_gradient,
        critic_reads_carries=critic_reads_carries,
        actor_reads_carries=actor_reads_carries,
    )


def gather_segments(
    replay: Replay,
    first: jax.Array,
    count: jax.Array,
    window_tokens: int,
    history_length: jax.Array | int,
    length: int,
    burn_in_gradient: bool,
    *,
    critic_reads_carries: bool = True,
    actor_reads_carries: bool = False,
) -> Batch:
    """The batch of the segments that begin at these numbers (int32 [M]); see `sample_segments`.

    The transitions have the order of `Segment`: the place is the fastest index.
    """
    kept = replay.transitions
    segment, slots = segment_at(
        kept.step,
        kept.episode_step,
        first,
        count,
        window_tokens,
        length,
        history_length,
        burn_in_gradient,
        replay.environments,
    )
    slot, action = slots.reshape(-1), segment.action
    step_number = flat(
        first[None, :] + replay.environments * jnp.arange(length, dtype=jnp.int32)[:, None]
    )
    carry = next_carry = None
    if critic_reads_carries:
        carry, next_carry = _stored_carries(replay, step_number, kept.episode_step[slot])
    if actor_reads_carries and replay.carries is not None:
        segment = dataclasses.replace(
            segment, start=_carry_at(replay.carries, first - replay.environments * window_tokens)
        )
    following = dataclasses.replace(
        segment,
        observation=kept.next_observation[slot],
        previous_action=action,
        following=True,
    )
    batch = Batch(
        window=segment,
        action=action,
        reward=kept.reward[slot],
        terminated=kept.terminated[slot],
        next_window=following,
        carry=carry,
        next_carry=next_carry,
    )
    return _with_truth(batch, kept.truth, slot)


def _stored_carries(
    replay: Replay, step_number: jax.Array, episode_step: jax.Array
) -> tuple[Carry | None, Carry | None]:
    """The behaviour actor's carries before the steps ``step_number`` (int32 [B]), and after."""
    if replay.carries is None:
        return None, None
    carry = jax.tree.map(
        functools.partial(where_rows, episode_step == 0, 0.0),
        _carry_at(replay.carries, step_number),
    )
    return carry, _carry_at(replay.carries, step_number + replay.environments)


def _carry_at(carries: Carry, step_number: jax.Array) -> Carry:
    slot = _carry_slot(carries, step_number)
    return jax.tree.map(lambda kept: kept[slot], carries)


def _carry_slot(carries: Carry, step_number: jax.Array) -> jax.Array:
    return step_number % jax.tree.leaves(carries)[0].shape[0]
