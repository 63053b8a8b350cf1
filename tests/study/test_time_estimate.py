"""Tests the time estimate: some programs are measured, the others are interpolated."""

import os
import signal
import threading
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.study import plan, time_estimate
from rtd3jax.training.jobs import make_jobs


def _jobs(algorithm, seeds=2, **changes):
    fields = dict(total_steps=1_000, hidden_size=4, batch_size=4, learning_starts=200)
    config = rtd.Config(algorithm, **{**fields, "eval_every": 500, "eval_episodes": 1, **changes})
    return make_jobs(rtd.make("rover", "ar1-slip"), config, list(range(seeds)))


def test_what_is_not_timed_lies_between_what_is(monkeypatch):
    jobs = [job for length in range(1, 8) for job in _jobs("lstm-td3", history_length=length)]
    asked = []

    def seconds(group):
        asked.append(group[0].program.window_tokens)
        return 10.0 * group[0].program.window_tokens

    monkeypatch.setattr(time_estimate, "group_seconds", seconds)
    monkeypatch.setattr(time_estimate, "workers", lambda: [None] * 4)
    operations = lambda config: float(config.window_tokens)  # noqa: E731
    assert time_estimate.study_seconds(jobs, "map", operations) == pytest.approx(2 * 280 / 4)
    assert len(asked) == time_estimate.MOST_PROGRAMS and {1, 7} <= set(asked)
    # Side by side, each of a program's lanes has a worker of its own here.
    assert time_estimate.study_seconds(jobs, "vmap", operations) == pytest.approx(280)


@pytest.mark.parametrize(
    ("strategy", "workers", "lanes", "at_once", "seconds", "measured"),
    [
        ("map", 64, 5, None, 10.0, [1] * 5),  # each lane has a core, and no lane has two
        ("map", 4, 10, None, 25.0, [1] * 4),
        ("map", 4, 10, 2, 50.0, [1] * 2),  # of four cores, two have no memory for a lane
        ("vmap", 1, 10, None, 10.0, [10]),
        ("vmap", 1, 10, 4, 30.0, [4]),  # three waves
        ("vmap", 2, 10, 4, 20.0, [4, 4]),
        ("vmap", 2, 3, None, 10.0, [2, 2]),
        ("vmap", 2, 1, None, 10.0, [1]),
    ],
)
def test_the_plan_decides_what_is_measured_and_how_often_it_is_repeated(
    strategy, workers, lanes, at_once, seconds, measured, monkeypatch
):
    jobs, found = _jobs("td3", seeds=lanes), []

    def timed(group, device, together):
        found.append(len(group))
        return 10.0 / 800, 0.0

    monkeypatch.setattr(time_estimate, "workers", lambda: [None] * workers)
    monkeypatch.setattr(time_estimate, "_timed", timed)
    estimate = time_estimate.study_seconds(jobs, strategy, lambda config: 1.0, at_once=at_once)
    assert estimate == pytest.approx(seconds) and found == measured


def test_the_longest_lane_is_a_lower_bound(monkeypatch):
    jobs = [*_jobs("td3", seeds=3), *_jobs("td3", seeds=1, total_steps=8_000)]
    seconds = lambda group: group[0].program.config.total_steps / 1_000  # noqa: E731
    monkeypatch.setattr(time_estimate, "group_seconds", seconds)
    monkeypatch.setattr(time_estimate, "workers", lambda: [None] * 2)
    operations = lambda config: float(config.total_steps)  # noqa: E731
    assert time_estimate.study_seconds(jobs, "map", operations) == pytest.approx(8.0)


def test_a_dry_run_counts_the_lanes_that_wait_for_memory(monkeypatch):
    jobs, asked = _jobs("td3", seeds=4), []
    monkeypatch.setattr(plan, "workers", lambda: [jax.devices()[0]] * 4)
    monkeypatch.setattr(plan, "study_seconds", lambda *given: asked.append(given[-1]) or 60.0)
    monkeypatch.setattr(plan, "lanes_at_once", lambda *_: 3)
    text = plan.plan_text([], range(4), jobs, "map", 2**30)
    assert asked == [3] and "3; the other 1 wait" in text


def test_a_lane_is_timed_without_its_random_steps(monkeypatch):
    monkeypatch.setattr(time_estimate, "_SECONDS", 0.05)
    (job, _), told = _jobs("td3"), []
    seconds = time_estimate.study_seconds([job], "map", lambda config: 1.0, told.append)
    assert np.isfinite(seconds) and seconds > 0.0
    assert told == ["timing 1 of 1: td3"]
    (untrained, _) = _jobs("td3", total_steps=1_000, learning_starts=1_000)
    monkeypatch.setattr(time_estimate, "_timed", lambda *_: (1.0, 5.0))
    with_updates, without = (
        time_estimate.group_seconds([job]),
        time_estimate.group_seconds([untrained]),
    )
    assert (with_updates, without) == (800 + 2 * 5, 2 * 5)


def test_the_seconds_of_a_step_leave_out_the_first_call_and_the_evaluations(monkeypatch):
    now, calls = [0.0], []

    def advance(lane, state, start, stop):
        start, stop = int(start), int(stop)
        ends = stop // 100 - start // 100  # evaluations
        now[0] += 0.01 * (stop - start) + 3.0 * ends + (0.0 if calls else 60.0)
        calls.append((start, stop))
        return state

    monkeypatch.setattr(time_estimate, "compiled", lambda *_: (lambda lane: 0, advance))
    monkeypatch.setattr(time_estimate, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    together = threading.Barrier(1)
    jobs = _jobs("td3", eval_every=100)[:1]
    step, evaluation = time_estimate._timed(jobs, jax.devices()[0], together)
    assert (step, evaluation) == (pytest.approx(0.01), pytest.approx(3.0))
    assert calls[-1] == (99, 100)


def test_what_fails_while_it_is_timed_is_raised(monkeypatch):
    def fail(jobs, device, together):
        raise rtd.UserError("no such device")

    monkeypatch.setattr(time_estimate, "_timed", fail)
    with pytest.raises(rtd.UserError, match="no such device"):
        time_estimate.group_seconds(_jobs("td3"))


def test_no_measurement_outlives_an_interrupt(monkeypatch):
    """A process that ends while a thread is inside XLA aborts."""
    begun, ended, jobs = [], [], _jobs("td3")

    def measure(jobs, device, together):
        begun.append(device)
        if device == "second":
            while len(begun) < 2:
                time.sleep(0.01)
            os.kill(os.getpid(), signal.SIGINT)  # the main thread handles it
        while not together.broken:
            time.sleep(0.01)
        ended.append(device)
        raise threading.BrokenBarrierError

    monkeypatch.setattr(time_estimate, "_timed", measure)
    monkeypatch.setattr(time_estimate, "workers", lambda: ["first", "second"])
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            time_estimate.group_seconds(jobs)
    finally:
        signal.signal(signal.SIGINT, before)
    assert sorted(ended) == ["first", "second"]


def test_lanes_of_one_program_and_other_disturbances_are_timed_apart(monkeypatch):
    """Equal environments can have parameters of another structure, which cannot be stacked."""
    monkeypatch.setattr(time_estimate, "_SECONDS", 0.05)
    fields = dict(total_steps=1_000, hidden_size=4, batch_size=4, learning_starts=200)
    config = rtd.Config("td3", **fields, eval_every=500, eval_episodes=1)
    slips = [rtd.make("rover", name) for name in ("ar1-slip", "sine-slip")]
    jobs = [job for env in slips for job in make_jobs(env, config, [0])]
    assert jobs[0].program == jobs[1].program and jobs[0].executable != jobs[1].executable
    told = []
    assert time_estimate.study_seconds(jobs, "vmap", lambda config: 1.0, told.append) > 0.0
    assert len(told) == 2
