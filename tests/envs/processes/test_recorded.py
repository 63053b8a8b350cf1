"""Compares replayed disturbances with the recorded rows."""

import json
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.envs import registry
from rtd3jax.envs.rover import Rover, RoverParams
from rtd3jax.envs.rover.slip import ConstantSlip
from rtd3jax.errors import UserError
from rtd3jax.system.files import read_arrays

STEPS = 10
COMMAND = rtd.constant_policy([0.5, 0.0])


def numbered(*lengths, columns=2):
    """Stretches whose values say which recording, row and column they are."""
    return [
        np.array([[100 * e + t + 0.25 * k for k in range(columns)] for t in range(length)])
        for e, length in enumerate(lengths)
    ]


def offsets(process, steps=STEPS, episodes=400, size=2):
    """What is added: [episodes, steps, size]."""

    def episode(key):
        state = process.init(key, steps, size)

        def step(state, key):
            out, state = process.step(key, state, jnp.zeros((size,), jnp.float32))
            return state, out

        return jax.lax.scan(step, state, jax.random.split(key, steps))[1]

    return np.asarray(jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0), episodes)))


def test_every_start_that_fits_is_as_likely_and_rows_follow_each_other():
    played = offsets(rtd.Recorded(numbered(13, 5, 11), channel="action"))
    assert np.all(np.diff(played, axis=1) == 1.0)
    assert np.all(played[:, :, 1] == played[:, :, 0] + 0.25)
    starts, counts = np.unique(played[:, 0, 0], return_counts=True)
    # The second is too short to be played at all; 4 + 2 starts are left.
    assert starts.tolist() == [0, 1, 2, 3, 200, 201]
    assert counts.min() > 0.6 * 400 / 6


def test_an_observation_needs_a_row_more():
    exact = numbered(STEPS)
    rtd.Recorded(exact, channel="action").check_use(STEPS, "action")
    with pytest.raises(UserError, match="has 10 rows, and an episode needs 11.*mirror=True"):
        rtd.Recorded(exact).check_use(STEPS, "observation")


def test_elements_of_their_own_are_drawn_by_themselves():
    played = offsets(rtd.Recorded(numbered(30), channel="action", independent=True))
    assert np.all(np.diff(played, axis=1) == 1.0)
    apart = played[:, 0, 1] - 0.25 - played[:, 0, 0]
    assert np.mean(apart != 0.0) > 0.8


def test_a_mirrored_recording_runs_back_and_forth():
    process = rtd.Recorded(numbered(4), channel="action", mirror=True)
    played = offsets(process)[:, :, 0]
    expected = np.array([0, 1, 2, 3, 2, 1] * 4)
    for row in played:
        assert row.tolist() == expected[int(row[0]) :][:STEPS].tolist()
    assert set(played[:, 0]) == {0, 1, 2, 3}
    still = rtd.Recorded(np.array([[7.0, 8.0]]), mirror=True)
    assert np.all(offsets(still) == [7.0, 8.0])


def test_bounds_and_elements():
    log = np.linspace(-2.0, 2.0, 41)
    process = rtd.Recorded(log, elements=(1,), bounds=(-1.0, 0.5))
    played = offsets(process, size=3)
    assert not np.any(played[:, :, [0, 2]])
    assert played.min() == -1.0 and played.max() == 0.5
    assert process.output_size(3) == 3


def test_bounds_are_replaced_and_the_reading_is_not():
    log = np.linspace(-2.0, 2.0, 41)
    wide = rtd.Recorded(log)
    bounded = wide.replace(bounds=(-1.0, 0.5))
    assert bounded == rtd.Recorded(log, bounds=(-1.0, 0.5)) != wide
    assert bounded.replace(mirror=True).low == -1.0
    with pytest.raises(UserError, match="low=1.0 is greater than high=0.0"):
        wide.replace(bounds=(1.0, 0.0))
    reading = {"log": log, "columns": ["a"], "episode": "run", "period": 0.1, "step": 0.2}
    for name, value in reading.items():
        with pytest.raises(UserError, match=f"{name} only acts when a log is read, .* read") as one:
            wide.replace(**{name: value})
        assert "\n" not in str(one.value)
    with pytest.raises(UserError, match="no parameter 'miror'; did you mean 'mirror'"):
        wide.replace(miror=True)


def test_slip_acts_as_the_rovers_own(tmp_path):
    slip = np.random.default_rng(0).uniform(0.0, 0.5, (20, 2))
    env = Rover(RoverParams(slip=rtd.Recorded(slip, channel="slip"), max_steps_in_episode=STEPS))
    played = rtd.rollout(COMMAND, env, episodes=3)
    assert played.hidden.shape == (3, STEPS, 2)
    for met, true in zip(played.hidden, played.true[:, 1:], strict=True):
        (start,) = np.flatnonzero(np.all(np.isclose(slip, met[0]), axis=1))
        np.testing.assert_allclose(met, slip[start : start + STEPS], rtol=1e-6)
        np.testing.assert_allclose(true[:, 0], -0.5 * met.mean(axis=1), atol=1e-6)
    rtd.plot_episode(played)
    assert rtd.find_problems(env) == []
    with pytest.raises(UserError, match="moments of Recorded are not known"):
        rtd.ceiling(env)


def test_equal_recordings_are_equal_and_share_a_program():
    log = numbered(12)
    one, same = rtd.Recorded(log), rtd.Recorded([part.copy() for part in log])
    other = rtd.Recorded([part + 1.0 for part in log])
    assert one == same and hash(one) == hash(same) and one != other and one != rtd.NoDisturbance()
    assert RoverParams(slip=one) == RoverParams(slip=same) != RoverParams(slip=other)
    assert one != one.replace(mirror=True) and one.replace(mirror=True).mirror
    traces = []

    @jax.jit
    def start(process):
        traces.append(process)
        return process.init(jax.random.key(0), STEPS, 2).value

    assert not np.array_equal(start(one), start(other))
    start(same)
    assert len(traces) == 1
    stacked = jax.tree.map(lambda a, b: jnp.stack([a, b]), one, other)
    values = jax.vmap(lambda process: process.init(jax.random.key(0), STEPS, 2).value)(stacked)
    np.testing.assert_array_equal(values, [start(one), start(other)])


def test_a_split_shares_out_whole_recordings():
    train, test = rtd.Recorded(numbered(10, 10, 10, 10, 10), channel="action").split(0.8)
    assert [part[0, 0] for part in train.sequences()] == [0, 100, 200, 300]
    assert [part[0, 0] for part in test.sequences()] == [400]
    assert set(offsets(test)[:, 0, 0]) == {400} and test.channel == "action"
    train, test = rtd.Recorded(numbered(20)).split(0.7)
    assert len(train.sequences()[0]) == 14 and test.sequences()[0][0, 0] == 14
    for fraction in (0.0, 1.0, 2.0, True, "0.8"):
        with pytest.raises(UserError, match="fraction"):
            train.split(fraction)
    with pytest.raises(UserError, match="1 rows cannot be split"):
        rtd.Recorded([[1.0, 2.0]]).split(0.5)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"channel": "actoin"}, "did you mean 'action'"),
        ({"channel": "slip"}, "goes from 0 to 11.2; divide it by the commanded speed"),
        ({"bounds": (1.0, 0.0)}, "low=1.0 is greater than high=0.0"),
        ({"bounds": 3.0}, "must be \\(low, high\\)"),
        ({"bounds": ([0.0] * 3, 1.0)}, "one number or 2 numbers"),
        ({"bounds": (0.0, float("nan"))}, "not finite"),
        ({"elements": (0,)}, "1 elements for a recording of 2 columns"),
        ({"elements": (0, 0)}, "distinct"),
        ({"elements": [0, 1]}, "must be a tuple"),
        ({"elements": (0.0, 1.5)}, "must be a tuple"),
        ({"mirror": 1}, "mirror must be True or False"),
        ({"colums": ["a"]}, "no parameter 'colums'; did you mean 'columns'"),
    ],
)
def test_what_makes_no_sense_is_one_line(arguments, match):
    with pytest.raises(UserError, match=match) as raised:
        rtd.Recorded(numbered(12), **arguments)
    assert "\n" not in str(raised.value)


def test_a_recording_that_does_not_fit_is_refused_before_compilation():
    with pytest.raises(UserError, match="Recorded needs a log"):
        rtd.Recorded()
    wide = rtd.Recorded(numbered(20, columns=3))
    offset = rtd.Recorded(numbered(20))
    with pytest.raises(UserError, match="recording of the observation cannot act on the slip"):
        rtd.evaluate(COMMAND, Rover(RoverParams(slip=offset, max_steps_in_episode=STEPS)))
    with pytest.raises(UserError, match="recording of the observation cannot act on the action"):
        rtd.evaluate(COMMAND, rtd.disturb(Rover(), offset, "action"))
    env = Rover(RoverParams(max_steps_in_episode=STEPS))
    with pytest.raises(UserError, match="has 3 elements and the observation 2"):
        rtd.disturb(env, wide)
    with pytest.raises(UserError, match="has 3 elements"):
        three = rtd.Recorded([part / 100 for part in numbered(20, columns=3)], channel="slip")
        rtd.evaluate(COMMAND, Rover(RoverParams(slip=three, max_steps_in_episode=STEPS)))
    short = rtd.disturb(env, rtd.Chain((rtd.Dropout(), rtd.Recorded(numbered(5)))))
    config = rtd.Config(total_steps=40, hidden_size=8, batch_size=8, learning_starts=20)
    for use in (
        lambda: rtd.train(short, config, seeds=[0]),
        lambda: rtd.evaluate(COMMAND, short),
        lambda: rtd.rollout(COMMAND, short),
        lambda: rtd.check_env(short),
    ):
        with pytest.raises(UserError, match="has 5 rows, and an episode needs 11"):
            use()


def test_checkpoints_know_the_recording_without_holding_it(tmp_path):
    log = np.random.default_rng(0).uniform(0.0, 0.4, (600, 2))
    config = rtd.Config(
        "td3", total_steps=20, hidden_size=8, batch_size=4, learning_starts=10, eval_every=20
    )
    arguments = {"seeds": [0], "progress": False, "checkpoint_dir": tmp_path}

    def rover(log):
        params = RoverParams(slip=rtd.Recorded(log, channel="slip"), max_steps_in_episode=STEPS)
        return Rover(params)

    first = rtd.train(rover(log), config, **arguments)
    (file,) = tmp_path.glob("seed-0/*.safetensors")
    assert len(json.dumps(read_arrays(file)[1])) < 4_000
    again = rtd.train(rover(log), config, **arguments)
    np.testing.assert_array_equal(again.returns, first.returns)
    with pytest.raises(UserError, match="belongs to another identity"):
        rtd.train(rover(log + 0.01), config, **arguments)
    first.policy(0).save(tmp_path / "policy.safetensors")
    loaded = rtd.load_policy(tmp_path / "policy.safetensors")
    env = rover(log)
    np.testing.assert_array_equal(
        rtd.evaluate(loaded, env, 3), rtd.evaluate(first.policy(0), env, 3)
    )


def test_a_registered_recording_is_made_by_name(monkeypatch):
    monkeypatch.setattr(registry, "_entries", dict(registry._entries))
    slip = rtd.Recorded(np.full((12, 2), 0.2), channel="slip")
    offset = rtd.Recorded(np.full((12, 2), 0.1), channel="observation")
    rtd.register("our-rover", Rover(), {"yard": ("slip", slip), "drift": offset})
    env = rtd.make("our-rover", "yard+drift", max_steps_in_episode=STEPS)
    assert env.default_params.env.slip == slip
    played = rtd.rollout(COMMAND, env)
    np.testing.assert_allclose(played.true[0, 1:, 0], -0.1, atol=1e-6)
    np.testing.assert_allclose(played.seen[0, 1:, 0], 0.0, atol=1e-6)
    with pytest.raises(UserError, match="12 rows, and an episode needs 200"):
        rtd.evaluate(COMMAND, rtd.make("our-rover", "yard"))
    mirrored = rtd.make("our-rover", "yard", mirror=True)
    assert rtd.evaluate(COMMAND, mirrored, 1).shape == (1,)


def test_a_split_leaves_episodes_whole_in_spite_of_gaps():
    log = np.stack(numbered(10, 10, 10, 10, 10))
    log[3, 2] = log[4, 8] = np.nan
    for recorded in (rtd.Recorded(log), rtd.Recorded(log).replace(mirror=True)):
        train, test = recorded.split(0.65)  # nearest to the gap of the fourth episode
        assert [part[0, 0] for part in train.sequences()] == [0, 100, 200]
        assert [part[0, 0] for part in test.sequences()] == [300, 303, 400, 409]
        train, test = test.split(0.5)
        assert [part[0, 0] for part in train.sequences()] == [300, 303]


def test_a_single_episode_with_a_gap_is_split_in_time():
    log = np.arange(10_000.0)
    log[50] = np.nan
    train, test = rtd.Recorded(log).split(0.8)
    assert [len(part) for part in train.sequences()] == [50, 7949]
    assert [part[0, 0] for part in test.sequences()] == [8000.0] and len(test.values) == 2000
    train, test = train.split(0.5)
    assert [len(part) for part in train.sequences()] == [50, 3950]


def test_a_split_far_from_the_wanted_one_warns():
    with pytest.warns(UserWarning, match="first side has 50% of the rows, not 80%, because"):
        rtd.Recorded(numbered(10, 10)).split(0.8)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rtd.Recorded(numbered(10, 10, 10, 10)).split(0.8)


@pytest.mark.parametrize(
    ("elements", "columns"), [((1, 0), [1, 0]), ((1,), [None, 0]), ((0,), [0, None])]
)
def test_slip_is_shown_at_the_wheel_that_it_acts_on(elements, columns):
    log = np.random.default_rng(0).uniform(0.1, 0.5, (STEPS, len(elements)))
    slip = rtd.Recorded(log, channel="slip", elements=elements)
    expected = np.stack(
        [np.zeros(STEPS) if column is None else log[:, column] for column in columns], axis=1
    )
    env = Rover(RoverParams(slip=slip, max_steps_in_episode=STEPS))
    frame = rtd.rollout(COMMAND, env).to_frame()
    np.testing.assert_allclose(frame[["slip left", "slip right"]][:-1], expected, rtol=1e-6)
    joined = rtd.Chain((slip, ConstantSlip(0.5)))
    env = Rover(RoverParams(slip=joined, max_steps_in_episode=STEPS))
    frame = rtd.rollout(COMMAND, env).to_frame()
    both = 1.0 - 0.5 * (1.0 - expected)
    np.testing.assert_allclose(frame[["slip left", "slip right"]][:-1], both, rtol=1e-6)
