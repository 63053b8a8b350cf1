"""Histories: the past tokens of an agent, read from a ring buffer (paper, Section 5.1).

A lane may have E environments that step together. Step s of environment e has the number
``s E + e``, so the number of the previous step is smaller by E.

The same function, `window_at`, is used for acting, replay, evaluation and deployment. Its
invariant: the existing tokens are the last tokens of the window. A token does not exist if it is
before the first step of the episode, older than the oldest step in the ring, or beyond the history
length; it is not a token of zeros. `segment_at` reads consecutive steps, whose tokens are computed
once for all of them.

Shapes: ``C`` capacity of the ring, ``L`` past tokens, ``B`` batch, ``M`` segments of ``m`` steps,
``O`` and ``A`` sizes of an observation and an action.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Steps:
    """A ring buffer of steps; step number n of a lane is in slot ``n % C``.

    Attributes:
        observation: [C, O], the observation of the step.
        previous_action: [C, A], the previous action; zero at the first step of an episode.
        action: [C, A], the action of the step.
    """

    observation: jax.Array
    previous_action: jax.Array
    action: jax.Array


@struct.dataclass
class Window:
    """The inputs of a network, except the current action, at one step of each of B episodes.

    Attributes:
        past: steps, leaves [L, B, ...], oldest first.
        length: int32 [B], the number of existing past tokens, which are the last ones.
        observation: [B, O], the current observation.
        previous_action: [B, A], the action before it; zero at an episode's first step.
        true_observation: [B, S], the undisturbed observation, for critics that read it; else None.
    """

    past: Steps
    length: jax.Array
    observation: jax.Array
    previous_action: jax.Array
    true_observation: jax.Array | None = None

    @property
    def exists(self) -> jax.Array:
        """Which of the past tokens exist: bool [L, B]."""
        offset = jnp.arange(self.past.action.shape[0], 0, -1, dtype=jnp.int32)
        return offset[:, None] <= self.length[None, :]


@struct.dataclass
class Segment:
    """The inputs of a network at m consecutive steps in each of M places: B = M m steps.

    All later steps share the tokens of earlier steps, whereas a window has separate tokens for each
    step. The steps [m, M] are flattened to [B]; the place is the fastest index.

    Attributes:
        steps: leaves [T, M, ...], T = L + m: the burn-in, then the m steps themselves.
        starts: bool [T, M], tokens before which there is no history: the first step of an episode,
            the oldest step in the ring, and the first step within the history length.
        observation: [B, O], the current observation.
        previous_action: [B, A], the action before it; zero at an episode's first step.
        begins: bool [M], whether the first token of the burn-in is the first of an episode.
        start: the behaviour actor's carry before the first token of the burn-in, leaves [M, ...].
            An actor that acts with a running carry starts from it (stored state and burn-in, as in
            Kapturowski et al., 2019). None if histories start with a zero carry. A burn-in that
            would begin before the oldest step in the ring starts there, with a zero carry.
        following: whether the current step is the step after each of the m steps.
        burn_in_gradient: whether gradients flow into the burn-in.
        true_observation: [B, S], as in `Window`.
    """

    steps: Steps
    starts: jax.Array
    observation: jax.Array
    previous_action: jax.Array
    begins: jax.Array
    start: Any
    following: bool = struct.field(pytree_node=False)
    burn_in_gradient: bool = struct.field(pytree_node=False)
    true_observation: jax.Array | None = None

    @property
    def length(self) -> int:
        """m, the number of the segment's steps without the burn-in."""
        return self.observation.shape[0] // self.starts.shape[1]

    @property
    def action(self) -> jax.Array:
        """[B, A], the actions of the m steps."""
        return flat(self.steps.action[-self.length :])

    @property
    def present(self) -> Window:
        """The current step only: a window without past tokens."""
        return present(self.observation, self.previous_action, self.true_observation)


History = Window | Segment
"""The inputs of a network at each step of a batch."""


def flat(rows: jax.Array) -> jax.Array:
    """[m, M, ...] as [m M, ...]."""
    return rows.reshape(-1, *rows.shape[2:])


def present(
    observation: jax.Array,
    previous_action: jax.Array,
    true_observation: jax.Array | None = None,
) -> Window:
    """The window without past tokens: ``observation`` [B, O] after ``previous_action`` [B, A]."""
    batch = observation.shape[0]
    past = Steps(
        observation=jnp.zeros((0, *observation.shape), jnp.float32),
        previous_action=jnp.zeros((0, *previous_action.shape), jnp.float32),
        action=jnp.zeros((0, *previous_action.shape), jnp.float32),
    )
    length = jnp.zeros((batch,), jnp.int32)
    return Window(past, length, observation, previous_action, true_observation)


def empty_steps(capacity: int, observation_size: int, action_size: int) -> Steps:
    """A ring without steps."""
    return Steps(
        observation=jnp.zeros((capacity, observation_size), jnp.float32),
        previous_action=jnp.zeros((capacity, action_size), jnp.float32),
        action=jnp.zeros((capacity, action_size), jnp.float32),
    )


def put_row(ring: jax.Array, slot: jax.Array, row: jax.Array) -> jax.Array:
    """``ring`` [C, ...] with ``row`` [...] in ``slot``; written in place under jit."""
    return jax.lax.dynamic_update_index_in_dim(ring, row.astype(ring.dtype), slot, axis=0)


def put_rows(ring: jax.Array, slot: jax.Array, rows: jax.Array) -> jax.Array:
    """``ring`` [C, ...] with ``rows`` [E, ...] from ``slot`` on; written in place under jit."""
    return jax.lax.dynamic_update_slice_in_dim(ring, rows.astype(ring.dtype), slot, axis=0)


def put_step(ring: Steps, step_number: jax.Array, step: Steps) -> Steps:
    """The ring after step ``step_number`` (int32 []), whose leaves are [O] and [A]."""
    slot = step_number % ring.action.shape[0]
    return jax.tree.map(lambda kept, row: put_row(kept, slot, row), ring, step)


def window_at(
    ring: Steps,
    step_number: jax.Array,
    episode_step: jax.Array,
    count: jax.Array,
    window_tokens: int,
    history_length: jax.Array | int,
    observation: jax.Array,
    previous_action: jax.Array,
    environments: int = 1,
) -> Window:
    """The window of step ``step_number``.

    Args:
        ring: the steps.
        step_number: int32 [B], at most ``count``.
        episode_step: int32 [B], number of earlier steps of the same episode.
        count: int32 [], number of steps written so far; the ring holds the last C of them.
        window_tokens: L, past tokens in the window's arrays.
        history_length: l <= L, past tokens that may be read.
        observation: [B, O], the observation of the step.
        previous_action: [B, A], the action of the previous step.
        environments: E, number of environments that step together.
    """
    capacity = ring.action.shape[0]
    offset = environments * jnp.arange(window_tokens, 0, -1, dtype=jnp.int32)
    slots = (step_number[None, :] - offset[:, None]) % capacity
    past = jax.tree.map(lambda kept: kept[slots], ring)
    oldest = jnp.maximum(count - capacity, 0)
    length = _limited(
        jnp.minimum(episode_step, (step_number - oldest) // environments),
        window_tokens,
        history_length,
    )
    return Window(past, length, observation, previous_action)


def segment_at(
    ring: Steps,
    episode_steps: jax.Array,
    first: jax.Array,
    count: jax.Array,
    window_tokens: int,
    length: int,
    history_length: jax.Array | int,
    burn_in_gradient: bool,
    environments: int = 1,
) -> tuple[Segment, jax.Array]:
    """The m steps of an environment from ``first`` on with their burn-in, and their slots [m, M].

    Args:
        ring: the steps.
        episode_steps: int32 [C], number of earlier steps of the same episode, for each step.
        first: int32 [M], the number of the first of the m steps; the last is less than ``count``.
        count: int32 [], number of steps written so far; the ring holds the last C of them.
        window_tokens: L, tokens of the burn-in.
        length: m.
        history_length: l <= L, tokens of the burn-in that may be read.
        burn_in_gradient: see `Segment`.
        environments: E, number of environments that step together.
    """
    capacity = episode_steps.shape[0]
    offset = jnp.arange(-window_tokens, length, dtype=jnp.int32)
    step_number = first[None, :] + environments * offset[:, None]
    slots = step_number % capacity
    oldest = jnp.maximum(count - capacity, 0)
    starts = (
        (episode_steps[slots] == 0)
        | (step_number // environments == oldest // environments)
        | (offset == -history_length)[:, None]
    )
    steps = jax.tree.map(lambda kept: kept[slots], ring)
    segment = Segment(
        steps=steps,
        starts=starts,
        observation=flat(steps.observation[window_tokens:]),
        previous_action=flat(steps.previous_action[window_tokens:]),
        begins=episode_steps[slots[0]] == 0,
        start=None,
        following=False,
        burn_in_gradient=burn_in_gradient,
    )
    return segment, slots[window_tokens:]


def next_window(
    window: Window, action: jax.Array, next_observation: jax.Array, history_length: jax.Array | int
) -> Window:
    """The window one step later, in which the current step is a past token.

    Args:
        window: the window of the current step.
        action: [B, A], the action of the current step.
        next_observation: [B, O], the next observation; it may be a final observation.
        history_length: l, the maximum number of past tokens.
    """
    current = Steps(window.observation, window.previous_action, action)
    window_tokens = window.past.action.shape[0]
    past = jax.tree.map(
        lambda old, new: jnp.concatenate((old, new[None]))[1:] if window_tokens else old,
        window.past,
        current,
    )
    length = _limited(window.length + 1, window_tokens, history_length)
    return Window(past, length, next_observation, action)


def _limited(length: jax.Array, window_tokens: int, history_length: jax.Array | int) -> jax.Array:
    """``length`` int32 [B], limited by the window's arrays and the history length."""
    return jnp.minimum(jnp.minimum(length, window_tokens), history_length).astype(jnp.int32)
