"""Compares sampled windows, masks, next windows and stored carries with a slow numpy oracle."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rtd3jax.agents.history import Steps
from rtd3jax.agents.memory.lstm import Carry, zero_carry
from rtd3jax.agents.replay import (
    Transition,
    empty_replay,
    gather,
    put_carries,
    put_transitions,
    sample,
)

# One program for each capacity, rather than one for each operation.
put_transitions, put_carries = jax.jit(put_transitions), jax.jit(put_carries)
gather = jax.jit(gather, static_argnums=3)


def _history(lengths):
    """Rows of whole episodes; every number in them tells where it comes from."""
    rows, number = [], 0
    for episode, length in enumerate(lengths):
        for episode_step in range(length):
            rows.append(
                dict(
                    observation=[episode, episode_step],
                    previous_action=[100 * episode + episode_step - 1 if episode_step else 0.0],
                    action=[100 * episode + episode_step],
                    next_observation=[episode, episode_step + 1],
                    episode_step=episode_step,
                    terminated=episode_step == length - 1 and episode % 2 == 0,
                    reward=number,
                )
            )
            number += 1
    return rows


def _store(rows, capacity):
    """Write the rows, and carries as the loop does: before each step; after each end."""
    replay = empty_replay(capacity, 2, 1, zero_carry(1, 1))
    for number, row in enumerate(rows):
        if row["episode_step"]:
            replay = put_carries(replay, jnp.int32(number), _row(_carry(row["observation"])))
        array = {k: jnp.asarray(v, jnp.float32) for k, v in row.items()}
        transition = Transition(
            step=Steps(array["observation"], array["previous_action"], array["action"]),
            reward=array["reward"],
            next_observation=array["next_observation"],
            terminated=jnp.asarray(row["terminated"]),
            episode_step=jnp.int32(row["episode_step"]),
        )
        replay = put_transitions(replay, jnp.int32(number), _row(transition))
        replay = put_carries(replay, jnp.int32(number + 1), _row(_carry(row["next_observation"])))
    return replay


def _row(leaves):
    """Of the one environment."""
    return jax.tree.map(lambda leaf: leaf[None], leaves)


def _carry(observation):
    """A carry that names the observation before which it stands."""
    value = jnp.asarray([10_000.0 * observation[0] + observation[1]], jnp.float32)
    return Carry(value, -value)


def _oracle_past(rows, number, capacity, history_length, last):
    """Indices of the past tokens of row ``number``; ``last`` is the newest row written."""
    oldest = max(0, last + 1 - capacity)
    episode = rows[number]["observation"][0]
    return [
        k
        for k in range(number - history_length, number)
        if k >= oldest and rows[k]["observation"][0] == episode
    ]


@given(
    lengths=st.lists(st.integers(1, 7), min_size=1, max_size=8),
    capacity=st.integers(3, 40),
    tokens=st.integers(0, 5),
    less=st.integers(0, 2),
)
@settings(max_examples=12)  # every example has shapes of its own to compile
def test_windows_and_carries_equal_the_oracle(lengths, capacity, tokens, less):
    history_length = max(tokens - less, 0)
    rows = _history(lengths)
    replay = _store(rows, capacity)
    count = len(rows)
    kept = np.arange(max(0, count - capacity), count)
    batch = gather(
        replay, jnp.asarray(kept, jnp.int32), jnp.int32(count), tokens, jnp.int32(history_length)
    )
    for b, number in enumerate(kept):
        row = rows[number]
        past = _oracle_past(rows, number, capacity, history_length, count - 1)
        after = [*past, number][-history_length:] if history_length else []
        current = dict(observation=row["observation"], previous_action=row["previous_action"])
        following = dict(observation=row["next_observation"], previous_action=row["action"])
        for window, indices, now in (
            (batch.window, past, current),
            (batch.next_window, after, following),
        ):
            exists = np.asarray(window.exists)[:, b]
            assert exists.sum() == len(indices) == int(window.length[b])
            assert not np.any(exists[: tokens - len(indices)])
            for part in ("observation", "previous_action", "action"):
                got = np.asarray(getattr(window.past, part))[tokens - len(indices) :, b]
                want = [rows[k][part] for k in indices]
                assert got.tolist() == want
            for part, want in now.items():
                assert np.asarray(getattr(window, part))[b].tolist() == list(want)
        assert float(batch.reward[b]) == row["reward"]
        assert bool(batch.terminated[b]) == row["terminated"]
        carry = (
            _carry(row["observation"]) if row["episode_step"] else Carry(jnp.zeros(1), jnp.zeros(1))
        )
        for got, want in (
            (batch.carry, carry),
            (batch.next_carry, _carry(row["next_observation"])),
        ):
            assert float(got.hidden[b, 0]) == float(want.hidden[0])
            assert float(got.cell[b, 0]) == float(want.cell[0])


def test_samples_are_uniform_over_the_rows_kept():
    rows = _history([5, 5, 5])
    replay = _store(rows, capacity=8)
    batch = sample(replay, jax.random.key(0), jnp.int32(15), 8_000, 2, 2)
    numbers, counts = np.unique(np.asarray(batch.reward), return_counts=True)
    assert numbers.tolist() == list(range(7, 15))
    assert np.all(np.abs(counts - 1_000) < 150)
