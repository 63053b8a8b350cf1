"""Tests the end of the processes and tasks that train lanes, which write checkpoints then."""

import contextlib
import signal
import types

import pytest

from rtd3jax.study import cluster
from rtd3jax.study.crew import Crew


class Member:
    """A process; while it is waited for, the user presses Ctrl-C ``times`` times."""

    def __init__(self, times, happened):
        self.times, self.happened = times, happened

    def end(self):
        self.happened.append("told")

    def wait(self, seconds):
        for _ in range(self.times):
            signal.raise_signal(signal.SIGINT)
        self.happened.append("ended")

    def kill(self):
        self.happened.append("killed")


@pytest.fixture(autouse=True)
def interruptible():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("times", "happened"),
    [
        (1, ["told", "told", "ended", "ended", "killed", "killed"]),
        (2, ["told", "told", "killed", "killed"]),
    ],
)
def test_processes_that_save_are_only_killed_after_a_message(times, happened, capsys):
    found = []
    crew = Crew([], {}, ())
    crew.members = [Member(times, found), Member(0, found)]
    with contextlib.suppress(KeyboardInterrupt):
        crew._end()
    assert found == happened
    said = capsys.readouterr().err
    assert "write checkpoints; another interrupt" in said and said.count("\n") == 1


@pytest.mark.parametrize(("times", "whole"), [(1, True), (2, False)])
def test_tasks_of_a_cluster_that_save_are_only_left_after_a_message(times, whole, capsys):
    cancelled, ended = [], []

    def wait(tasks, timeout, num_returns=1):
        if not cancelled:
            raise KeyboardInterrupt
        for _ in range(times):
            signal.raise_signal(signal.SIGINT)
        ended.append(num_returns)

    ray = types.SimpleNamespace(wait=wait, cancel=lambda task, force: cancelled.append(task))
    directory = types.SimpleNamespace(cells=[], seeds=[])
    with pytest.raises(KeyboardInterrupt):
        cluster._watch(ray, directory, {"a": [], "b": []}, [], None, None, quiet=True)
    assert cancelled == ["a", "b"] and ended == [2] * whole
    said = capsys.readouterr().err
    assert "write checkpoints; another interrupt" in said and said.count("\n") == 1
