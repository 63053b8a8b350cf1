"""Tests how many lanes each process trains, the memory for them, and their progress."""

import os
import queue
import types

import numpy as np
import pytest

from rtd3jax.errors import UserError
from rtd3jax.study import process_plan, processes
from rtd3jax.study.cells import Grid, cell_jobs, make_cells
from rtd3jax.study.memory_plan import processes_bytes
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.training.grouping import make_groups
from rtd3jax.training.progress import Progress


def lanes_of(seeds, **overrides):
    cells = make_cells([Grid("rover", ("ar1-slip",), ("td3",))], overrides)
    return cell_jobs(cells, range(seeds), "map")


@pytest.fixture
def eight_cores(monkeypatch):
    monkeypatch.setattr(process_plan, "cores", lambda: 8)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)))


def test_there_is_no_room_for_more_lanes_than_there_are(eight_cores, monkeypatch):
    jobs = lanes_of(5)
    monkeypatch.setattr(process_plan, "memory_limit", lambda: processes_bytes(jobs, 2, 3))
    shares = process_plan.shares_of(2, jobs, "map")
    assert shares.lanes == 3 and [len(cores) for cores in shares.cores] == [4, 4]
    monkeypatch.setattr(process_plan, "memory_limit", lambda: 2**40)
    assert process_plan.shares_of(2, lanes_of(80), "map").lanes == 4


def test_the_number_of_processes_that_is_named_has_enough_memory(eight_cores, monkeypatch):
    jobs = lanes_of(80)
    for limit, fewer in ((processes_bytes(jobs, 4, 2), 4), (2**20, 1)):
        monkeypatch.setattr(process_plan, "memory_limit", lambda limit=limit: limit)
        with pytest.raises(UserError, match=f"use --processes {fewer}, or lower replay_capacity"):
            process_plan.shares_of(8, jobs, "map")
        assert process_plan.shares_of(fewer, jobs, "map").processes == fewer


def test_the_memory_is_that_of_the_processes_that_start(eight_cores, monkeypatch):
    """A lane that waits alone needs one process."""
    jobs = lanes_of(1)
    monkeypatch.setattr(process_plan, "memory_limit", lambda: processes_bytes(jobs, 1, 1))
    assert process_plan.shares_of(8, jobs, "map").processes == 1
    with pytest.raises(UserError, match="use --processes 1, or lower replay_capacity"):
        process_plan.shares_of(8, lanes_of(2), "map")


class Member:
    """A process that only takes orders."""

    def __init__(self, cores=(0, 1, 2)):
        self.cores, self.lanes, self.executable, self.ready = cores, [], None, True

    def order(self, lanes, names):
        self.lanes, self.executable = list(lanes), lanes[0].jobs[0].executable


@pytest.fixture
def study(tmp_path):
    """A function that makes a study of four lanes, its groups and its two processes."""

    def make(at_once, show=lambda group: None):
        jobs, told = lanes_of(4, total_steps=3_000), queue.SimpleQueue()
        directory = RunDirectory.create(tmp_path / "run", [jobs[0].cell], range(4), 2)
        crew = types.SimpleNamespace(members=[Member(), Member()], told=told)
        crew.messages = lambda seconds: iter([told.get()])
        groups = make_groups(jobs, "map", 1)
        return processes._Study(directory, groups, crew, at_once, [], show), crew, groups

    return make


@pytest.mark.parametrize(("at_once", "lanes"), [(2, [2, 2]), (5, [3, 1])])
def test_a_process_leaves_lanes_for_the_others(at_once, lanes, study):
    """It has at most a lane for each of its cores, and at most its share of the lanes."""
    made, crew, _ = study(at_once)
    made.give()
    assert [len(member.lanes) for member in crew.members] == lanes


def test_steps_of_a_checkpoint_do_not_count_for_the_speed_of_processes(study, monkeypatch):
    from rtd3jax.training import progress

    now = [0.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    bars = []
    made, crew, groups = study(1, lambda group: bars[0].update(group))
    bars.append(Progress(groups, str))
    made.give()
    (task,) = bars[0]._bar.tasks

    def tell(step, began_at):
        message = {"lane": [0, 0], "step": step, "began_at": began_at, "returns": [np.nan]}
        crew.told.put((crew.members[0], message))
        now[0] += 10.0
        made.listen()

    tell(2_100, 2_000)
    assert task.fields["rate"] == "10 steps/s" and task.completed == 2_100
    # After a kill, another process continues from a checkpoint of this session: its steps count.
    tell(2_200, 2_050)
    assert task.fields["rate"] == "10 steps/s" and task.completed == 2_200
