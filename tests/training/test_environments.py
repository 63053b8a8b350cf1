"""Tests of several environments for one learner: each row belongs to one of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_loop import Clock

import rtd3jax as rtd
from rtd3jax.agents.networks import act
from rtd3jax.agents.replay import gather, gather_segments
from rtd3jax.training.feasibility import updates_of
from rtd3jax.training.lane import make_lane
from rtd3jax.training.loop import make_program

K, STEPS, CAPACITY, LENGTH = 3, 90, 60, 3
FIELDS = dict(
    history_length=LENGTH,
    hidden_size=4,
    batch_size=4,
    eval_episodes=1,
    environments=K,
    total_steps=STEPS,
    eval_every=STEPS,
)


def _lane(config, cuts):
    env = Clock()
    program = make_program(env, config, 2, (1,))
    lane = make_lane(config, 0, env.default_params)
    state, advance = jax.jit(program.init)(lane), jax.jit(program.advance)
    for begin, end in zip(cuts, cuts[1:], strict=False):
        state = advance(lane, state, jnp.int32(begin), jnp.int32(end))
    return program, lane, state


@pytest.fixture(scope="module", params=["windows", "segments"])
def lane(request):
    """h-td3, which never learns, with a ring that has wrapped."""
    config = rtd.Config(
        algorithm="h-td3",
        replay=request.param,
        learning_starts=STEPS,
        replay_capacity=CAPACITY,
        **({"segment_length": 4} if request.param == "segments" else {}),
        **FIELDS,
    )
    return _lane(config, (0, 3, 21, STEPS))


def _episodes(state):
    """The rows that are kept, by number: (environment, row as a dict)."""
    rows = jax.tree.map(np.asarray, state.replay.transitions)
    found = {}
    for number in range(STEPS - CAPACITY, STEPS):
        slot = number % CAPACITY
        found[number] = {
            "seen": rows.step.observation[slot],
            "previous": rows.step.previous_action[slot],
            "action": rows.step.action[slot],
            "next": rows.next_observation[slot],
            "terminated": rows.terminated[slot],
            "step": int(rows.episode_step[slot]),
        }
    return found


def test_each_environments_rows_are_its_own_episodes(lane):
    rows = _episodes(lane[2])
    episodes = [set() for _ in range(K)]
    for number, row in rows.items():
        episodes[number % K].add(float(row["seen"][0]))
        assert row["step"] == row["seen"][1]
        np.testing.assert_array_equal(row["next"], row["seen"] + [0, 1])
        odd = row["seen"][0] % 2 == 1
        assert row["terminated"] == (odd and row["step"] == 3)
        before = rows.get(number - K)
        if before is not None and row["step"]:
            np.testing.assert_array_equal(before["next"], row["seen"])
            np.testing.assert_array_equal(before["action"], row["previous"])
        if not row["step"]:
            assert not row["previous"].any()
    assert all(len(own) > 2 for own in episodes)
    assert not episodes[0] & episodes[1] and not episodes[1] & episodes[2]


def test_a_window_is_the_past_of_the_same_environment(lane):
    _, _, state = lane
    rows, numbers = _episodes(state), jnp.arange(STEPS - CAPACITY, STEPS, dtype=jnp.int32)
    batch = gather(state.replay, numbers, jnp.int32(STEPS), LENGTH, LENGTH)
    for index, number in enumerate(map(int, numbers)):
        past = []
        for back in range(1, LENGTH + 1):
            there = rows.get(number - back * K)
            if there is None or back > rows[number]["step"]:
                break
            past.insert(0, there)
        assert int(batch.window.length[index]) == len(past)
        seen = np.asarray(batch.window.past.observation[LENGTH - len(past) :, index])
        np.testing.assert_array_equal(seen.reshape(-1, 2), [row["seen"] for row in past] or seen)
        np.testing.assert_array_equal(batch.next_window.observation[index], rows[number]["next"])


def test_a_segment_is_consecutive_steps_of_one_environment(lane):
    _, _, state = lane
    rows, length = _episodes(state), 4
    first = jnp.arange(STEPS - CAPACITY, STEPS - (length - 1) * K, dtype=jnp.int32)
    batch = gather_segments(
        state.replay,
        first,
        jnp.int32(STEPS),
        LENGTH,
        LENGTH,
        length,
        True,
        actor_reads_carries=False,
    )
    seen = np.asarray(batch.window.observation).reshape(length, len(first), 2)
    starts = np.asarray(batch.window.starts)
    for index, number in enumerate(map(int, first)):
        own = [rows[number + K * step] for step in range(length)]
        np.testing.assert_array_equal(seen[:, index], [row["seen"] for row in own])
        for step in range(-LENGTH, length):
            there = rows.get(number + K * step)
            if there is None:
                continue
            oldest = number + K * step < STEPS - CAPACITY + K
            begins = there["step"] == 0 or oldest or step == -LENGTH
            assert starts[LENGTH + step, index] == begins


def test_a_segment_starts_from_its_own_environments_carry():
    """The actions are those from windows that reach back to the start of the episode."""
    config = rtd.Config(
        algorithm="h-td3",
        replay="segments",
        segment_length=4,
        learning_starts=STEPS,
        replay_capacity=CAPACITY,
        **FIELDS,
    )
    program, _, state = _lane(config, (0, STEPS))
    length, burn_in, whole_episode, count = 4, 2, 7, jnp.int32(STEPS)
    oldest = STEPS - CAPACITY + (burn_in + whole_episode) * K
    first = jnp.arange(oldest, STEPS - length * K, dtype=jnp.int32)
    segments = gather_segments(
        state.replay,
        first,
        count,
        burn_in,
        burn_in,
        length,
        True,
        critic_reads_carries=False,
        actor_reads_carries=True,
    )
    numbers = (first[None] + K * jnp.arange(length, dtype=jnp.int32)[:, None]).reshape(-1)
    windows = gather(state.replay, numbers, count, whole_episode, whole_episode)
    network, actor = program.agent.acting_actor, state.learner.actor
    for name in ("window", "next_window"):
        expected = act(network, actor, getattr(windows, name))
        found = act(network, actor, getattr(segments, name))
        np.testing.assert_allclose(found, expected, atol=1e-5)
    without = act(network, actor, windows.window.replace(length=jnp.zeros_like(numbers)))
    assert not np.allclose(without, act(network, actor, windows.window), atol=1e-4)


def test_lanes_side_by_side_store_what_each_stores_alone(lane):
    program = lane[0]
    lanes = [make_lane(program.config, seed, Clock().default_params) for seed in (0, 1)]

    def replay(lane):
        return program.advance(lane, program.init(lane), jnp.int32(0), jnp.int32(STEPS)).replay

    together = jax.jit(jax.vmap(replay))(jax.tree.map(lambda *x: jnp.stack(x), *lanes))
    for index, own in enumerate(lanes):
        alone = jax.tree.leaves(jax.jit(replay)(own))
        for one, all_lanes in zip(alone, jax.tree.leaves(together), strict=True):
            np.testing.assert_allclose(all_lanes[index], one, atol=1e-6)


def test_stored_carries_are_those_with_which_the_actor_acted(lane):
    """The greedy action from a stored carry is the one that was done, but for the noise."""
    program, lane_, state = lane
    numbers = jnp.arange(STEPS - CAPACITY + LENGTH * K, STEPS - K, dtype=jnp.int32)
    batch = gather(state.replay, numbers, jnp.int32(STEPS), LENGTH, LENGTH)
    network, actor = program.agent.acting_actor, state.learner.actor
    window = batch.window
    if program.config.has_running_carry:  # its memory reaches back to the episode's start
        window = window.replace(length=jnp.zeros_like(window.length))
        carried = act(network, actor, window, batch.carry)
        policy = program.policy(lane_, state)
        rows = _episodes(state)
        for index, number in enumerate(map(int, numbers)):
            history = []
            while number in rows:
                history.insert(0, rows[number])
                if not rows[number]["step"]:
                    break
                number -= K
            if history[0]["step"]:
                continue  # it began before the oldest row
            memory = policy.init()
            for row in history:
                memory = memory.replace(previous_action=jnp.asarray(row["previous"]))
                _, after = policy.step(memory, row["seen"])
                found, memory = memory, after
                memory = _with_action(program, policy, found, row)
            np.testing.assert_allclose(
                act(network, actor, _first(window, index), found.carry)[0],
                carried[index],
                atol=1e-5,
            )
    else:
        from_window = act(network, actor, window)
        from_carry = act(network, actor, window, batch.carry)
        np.testing.assert_allclose(from_carry, from_window, atol=1e-5)


def _first(window, index):
    return jax.tree.map(
        lambda leaf: leaf[:, index : index + 1] if leaf.ndim == 3 else leaf[index : index + 1],
        window,
    )


def _with_action(program, policy, before, row):
    """The policy's state after a step at which another action was done than its own."""
    from rtd3jax.agents.history import present
    from rtd3jax.agents.networks import advance

    window = present(jnp.asarray(row["seen"])[None], jnp.asarray(row["previous"])[None])
    carry = advance(
        program.agent.acting_actor,
        policy.actor,
        window,
        jnp.asarray(row["action"])[None],
        before.carry,
    )
    return before.replace(carry=carry, previous_action=jnp.asarray(row["action"]))


@pytest.mark.parametrize(
    ("update_every", "starts", "updates"), [(1, 10, 78), (3, 10, 26), (6, 10, 13), (9, 12, 9)]
)
def test_as_many_updates_as_with_one_environment(update_every, starts, updates):
    config = rtd.Config(
        algorithm="td3",
        learning_starts=starts,
        update_every=update_every,
        **{**FIELDS, "history_length": None},
    )
    _, _, state = _lane(config, (0, STEPS))
    assert updates_of(config)[0] == int(state.learner.critic_optimizer.count) == updates
    alone = updates_of(rtd.Config(**{**config.to_dict(), "environments": 1}))[0]
    assert abs(alone - updates) <= K


def test_however_it_is_cut_and_whatever_stands_beside_it():
    config = rtd.Config(algorithm="td3", learning_starts=12, **{**FIELDS, "history_length": None})
    _, _, whole = _lane(config, (0, STEPS))
    _, _, cut = _lane(config, (0, 3, 30, 33, STEPS))
    for one, two in zip(jax.tree.leaves(whole), jax.tree.leaves(cut), strict=True):
        if not jax.dtypes.issubdtype(one.dtype, jax.dtypes.prng_key):
            np.testing.assert_array_equal(one, two)
    runs = [rtd.train(Clock(), config, [0, 1], progress=False, strategy=s) for s in ("map", "vmap")]
    np.testing.assert_array_equal(runs[0].returns[0], whole.returns)
    np.testing.assert_allclose(runs[1].returns, runs[0].returns, rtol=1e-3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(total_steps=91), r"total_steps \(91\) is not a multiple of environments \(3\).*90"),
        (dict(eval_every=10), "eval_every .10. is not a multiple of environments"),
        (dict(replay_capacity=50), "replay_capacity .50. is not a multiple"),
        (
            dict(replay_capacity=12, history_length=4, batch_size=4),
            r"replay_capacity .12. holds less than .* a window of each of 3 environments .15.;",
        ),
        (dict(update_every=2), "update_every .2. and environments .3.: one must be a multiple"),
        (dict(environments=0), "environments must be at least 1"),
        (
            dict(replay="segments", segment_length=4, batch_size=8, learning_starts=9),
            "learning_starts .9. holds less than a segment of each environment.*= 12",
        ),
        (
            dict(replay="segments", segment_length=4, batch_size=8, replay_capacity=9),
            "replay_capacity .9. holds less than a segment of each environment",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(changes, message):
    with pytest.raises(rtd.UserError, match=message):
        rtd.Config(**{**FIELDS, "learning_starts": 12, **changes})
