"""Tests of normalised observations: the statistics, and independence of a sensor's unit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from follow import Follow, Params

import rtd3jax as rtd
from rtd3jax.agents.history import flat
from rtd3jax.agents.normalise import LIMIT, no_statistics
from rtd3jax.training.jobs import make_jobs
from rtd3jax.training.lane import make_lane
from rtd3jax.training.loop import make_program


def _statistics(rows):
    def note(statistics, row):
        return statistics.note(row[None]), None

    return jax.lax.scan(note, no_statistics(rows.shape[1]), jnp.asarray(rows, jnp.float32))[0]


def test_the_statistics_are_those_of_all_that_was_seen():
    rows = np.random.default_rng(0).normal([0, 1e4, -1e-4], [1, 3, 1e-5], (20_000, 3))
    rows = rows.astype(np.float32).astype(np.float64)
    found = _statistics(rows)
    assert int(found.count) == 20_000
    np.testing.assert_allclose(found.mean, rows.mean(0), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(np.sqrt(found.variance), rows.std(0), rtol=1e-3)
    read = np.asarray(found.normaliser()(jnp.asarray(rows, jnp.float32)))
    np.testing.assert_allclose(read.std(0), 1, rtol=2e-3)
    np.testing.assert_allclose(read.mean(0), 0, atol=2e-3)


def test_the_mean_follows_a_change_that_is_small_beside_the_sensors_zero():
    rows = np.random.default_rng(0).normal(101_325, 5, (30_000, 1))  # a barometer, in pascals
    rows[5_000:] += 20
    rows = rows.astype(np.float32).astype(np.float64)
    found = _statistics(rows)
    np.testing.assert_allclose(found.mean, rows.mean(0), atol=0.02)
    np.testing.assert_allclose(np.sqrt(found.variance), rows.std(0), rtol=1e-3)


@pytest.mark.parametrize("rows", [[[3.0, 1e6]], [[3.0, 1e6]] * 50])
def test_an_element_that_does_not_change_is_centred_only(rows):
    normaliser = _statistics(np.array(rows)).normaliser()
    np.testing.assert_array_equal(normaliser.scale, [1, 1])
    np.testing.assert_allclose(normaliser(jnp.asarray([4.0, 1e6])), [1, 0])


def test_an_outlier_is_cut_off():
    normaliser = _statistics(np.random.default_rng(0).normal(size=(100, 1))).normaliser()
    np.testing.assert_allclose(normaliser(jnp.asarray([[1e9], [-1e9]])), [[LIMIT], [-LIMIT]])


ENV = Follow()
UNITS = Params(unit=jnp.float32([1, 1, 1]))
SMALL = dict(
    history_length=2,
    total_steps=500,
    hidden_size=16,
    batch_size=32,
    learning_starts=100,
    eval_every=250,
    eval_episodes=5,
)


def _trained(unit, algorithm, **fields):
    fields = SMALL | dict(normalise_observations=True) | fields
    if algorithm == "td3":
        fields.pop("history_length")
    params = Params(unit=jnp.float32(unit))
    config = rtd.Config(algorithm=algorithm, **fields)
    return rtd.train(ENV, config, seeds=[0], params=params, progress=False)


@pytest.mark.parametrize(
    ("algorithm", "fields"),
    [
        ("td3", {}),
        ("lstm-td3-1ha1hc", dict(replay="segments", segment_length=4)),
        pytest.param("lstm-td3", {}, marks=pytest.mark.slow),
        pytest.param("h-td3", {}, marks=pytest.mark.slow),
    ],
)
def test_the_unit_of_a_sensor_does_not_matter(algorithm, fields):
    run = _trained([1, 1, 1], algorithm, **fields)
    # Powers of two are exact: the same to the bit. What is read anywhere as it is would show.
    other = _trained([2.0**14, 2.0**-14, 1], algorithm, **fields)
    np.testing.assert_array_equal(other.returns, run.returns)
    leaves = (jax.tree.leaves(r.policy(0).actor) for r in (run, other))
    for one, two in zip(*leaves, strict=True):
        np.testing.assert_array_equal(one, two)


def test_without_it_the_unit_does():
    plain = _trained([2.0**14, 2.0**-14, 1], "td3", normalise_observations=False)
    read = _trained([2.0**14, 2.0**-14, 1], "td3")
    assert read.returns[0, -1] > 0.5 * plain.returns[0, -1]  # returns are negative


def test_what_is_sampled_is_what_was_seen_as_networks_read_it():
    config = rtd.Config(algorithm="lstm-td3", normalise_observations=True, **SMALL)
    (job,) = make_jobs(ENV, config, [0], params=UNITS)
    state = job.program.init(job.lane)
    state = jax.jit(job.program.advance)(job.lane, state, jnp.int32(0), jnp.int32(150))
    rows = np.asarray(state.replay.transitions.step.observation[:150], np.float64)
    np.testing.assert_allclose(state.statistics.mean, rows.mean(0), atol=1e-5)
    sampled = state.replay, jax.random.key(1), jnp.int32(150), jnp.int32(2)
    raw = job.program.agent.sample(*sampled, None)
    read = job.program.agent.sample(*sampled, state.statistics.normaliser())
    mean, deviation = rows.mean(0), rows.std(0)
    for what in (
        lambda batch: batch.window.observation,
        lambda batch: batch.next_window.observation,
        lambda batch: flat(batch.window.past.observation),
        lambda batch: flat(batch.next_window.past.observation),
    ):
        want = (np.asarray(what(raw)) - mean) / deviation
        np.testing.assert_allclose(what(read), want, atol=1e-4)


def test_a_lane_without_it_keeps_no_statistics():
    config = rtd.Config(algorithm="td3", total_steps=2_000)
    program = make_program(ENV, config, 3, (2,))
    state = jax.eval_shape(program.init, make_lane(config, 0, UNITS))
    assert state.statistics is None


def test_what_is_neither_true_nor_false_is_refused():
    with pytest.raises(rtd.UserError, match="normalise_observations must be True or False"):
        rtd.Config(normalise_observations="yes")
