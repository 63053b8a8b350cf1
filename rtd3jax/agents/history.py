"""Histories: the tokens that an agent may read, cut from a ring of steps (paper, Section 5.1).

A lane may have several environments, K of them, which act side by side: step s of environment e is
step number ``s K + e``, so that the step before it is K numbers earlier.

One function, `window_at`, serves acting, replay, evaluation and deployment. Its invariant: the
tokens that exist are the last of the window. What is before an episode's first step, before the
oldest step kept, or beyond the history length does not exist; it is not a zero token. `segment_at`
cuts a stretch of steps instead, whose tokens are read once for all of them.

Shapes: ``C`` capacity of the ring, ``L`` past tokens, ``B`` batch, ``M`` segments of ``m`` steps,
``O`` and ``A`` sizes of an observation and an action.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Steps:
    """A ring of steps; step number n of a lane stands in slot ``n % C``.

    Attributes:
        observation: [C, O], what the agent saw at the step.
        previous_action: [C, A], the action before it; zero at an episode's first step.
        action: [C, A], what it did.
    """

    observation: jax.Array
    previous_action: jax.Array
    action: jax.Array


@struct.dataclass
class Window:
    """What a network may read at one step of each of B episodes, besides the current action.

    Attributes:
        past: steps, leaves [L, B, ...], oldest first.
        length: int32 [B], how many of the past tokens exist; they are the last ones.
        observation: [B, O], the current observation.
        previous_action: [B, A], the action before it; zero at an episode's first step.
    """

    past: Steps
    length: jax.Array
    observation: jax.Array
    previous_action: jax.Array

    @property
    def exists(self) -> jax.Array:
        """Which of the past tokens exist: bool [L, B]."""
        offset = jnp.arange(self.past.action.shape[0], 0, -1, dtype=jnp.int32)
        return offset[:, None] <= self.length[None, :]


@struct.dataclass
class Segment:
    """What a network may read at m consecutive steps in each of M places: B = M m steps.

    Every token serves all the steps after it, where a window has tokens for one step alone. The
    steps [m, M] lie flat, one place after the other within a step's number.

    Attributes:
        steps: leaves [T, M, ...], T = L + m: the burn-in, then the m steps themselves.
        starts: bool [T, M], tokens before which there is no history: an episode's first, the oldest
            step kept, and the first that the history length lets in.
        observation: [B, O], the current observation.
        previous_action: [B, A], the action before it; zero at an episode's first step.
        begins: bool [M], whether the burn-in's first token is an episode's first.
        start: the behaviour actor's carry before the burn-in's first token, leaves [M, ...], from
            which an actor goes on that acts with a running carry (Kapturowski et al., 2019, have
            both a stored state and a burn-in); None where histories begin with nothing.
        following: whether the current step is the one after each of the m steps.
        burn_in_gradient: whether a gradient flows back into the burn-in.
    """

    steps: Steps
    starts: jax.Array
    observation: jax.Array
    previous_action: jax.Array
    begins: jax.Array
    start: Any
    following: bool = struct.field(pytree_node=False)
    burn_in_gradient: bool = struct.field(pytree_node=False)

    @property
    def length(self) -> int:
        """m."""
        return self.observation.shape[0] // self.starts.shape[1]

    @property
    def action(self) -> jax.Array:
        """[B, A], what was done at the m steps."""
        return flat(self.steps.action[-self.length :])

    @property
    def present(self) -> Window:
        """The current step alone: a window without past tokens."""
        return present(self.observation, self.previous_action)


History = Window | Segment
"""What a network may read at each step of a batch."""


def flat(rows: jax.Array) -> jax.Array:
    """[m, M, ...] as [m M, ...]."""
    return rows.reshape(-1, *rows.shape[2:])


def present(observation: jax.Array, previous_action: jax.Array) -> Window:
    """The window without past tokens: ``observation`` [B, O] after ``previous_action`` [B, A]."""
    batch = observation.shape[0]
    past = Steps(
        observation=jnp.zeros((0, *observation.shape), jnp.float32),
        previous_action=jnp.zeros((0, *previous_action.shape), jnp.float32),
        action=jnp.zeros((0, *previous_action.shape), jnp.float32),
    )
    return Window(past, jnp.zeros((batch,), jnp.int32), observation, previous_action)


def empty_steps(capacity: int, observation_size: int, action_size: int) -> Steps:
    """A ring without steps."""
    return Steps(
        observation=jnp.zeros((capacity, observation_size), jnp.float32),
        previous_action=jnp.zeros((capacity, action_size), jnp.float32),
        action=jnp.zeros((capacity, action_size), jnp.float32),
    )


def put_row(ring: jax.Array, slot: jax.Array, row: jax.Array) -> jax.Array:
    """``ring`` [C, ...] with ``row`` [...] in ``slot``: one row is written, in place under jit."""
    return jax.lax.dynamic_update_index_in_dim(ring, row.astype(ring.dtype), slot, axis=0)


def put_rows(ring: jax.Array, slot: jax.Array, rows: jax.Array) -> jax.Array:
    """``ring`` [C, ...] with ``rows`` [K, ...] from ``slot`` on; in place under jit."""
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
    """What may be read at step ``step_number``.

    Args:
        ring: the steps.
        step_number: int32 [B], at most ``count``.
        episode_step: int32 [B], steps of the same episode before it.
        count: int32 [], steps ever written; the ring holds the last C of them.
        window_tokens: L, past tokens in the window's arrays.
        history_length: l <= L, past tokens that may be read.
        observation: [B, O], of the step.
        previous_action: [B, A], before it.
        environments: K, how many act side by side.
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
    """The m steps of an environment from ``first`` on, the burn-in before, and their slots [m, M].

    Args:
        ring: the steps.
        episode_steps: int32 [C], steps of the same episode before each.
        first: int32 [M], such that the last of the m steps is below ``count``.
        count: int32 [], steps ever written; the ring holds the last C of them.
        window_tokens: L, tokens of the burn-in.
        length: m.
        history_length: l <= L, tokens of the burn-in that may be read.
        burn_in_gradient: see `Segment`.
        environments: K, how many act side by side.
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
    """The window one step later: the current step has become a past token.

    Args:
        window: of the current step.
        action: [B, A], what was done.
        next_observation: [B, O], what was then seen, a final observation included.
        history_length: l, the most past tokens that may be read.
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
    """``length`` int32 [B], as far as the window's arrays and the agent's own length allow."""
    return jnp.minimum(jnp.minimum(length, window_tokens), history_length).astype(jnp.int32)
