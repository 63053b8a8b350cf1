"""Decides by how many processes the lanes of a study are trained on CPUs."""

import dataclasses
import os
from collections.abc import Sequence

from rtd3jax.config import Config
from rtd3jax.errors import UserError
from rtd3jax.study.memory_plan import processes_bytes
from rtd3jax.study.plan import update_flops
from rtd3jax.system.machine import core_quota, cores, memory_limit
from rtd3jax.training.lanes import Job, workers

LEAST_SECONDS = 300.0
"""Estimated seconds of a study from which processes pay: the start of a process takes seconds."""

_OPERATIONS_A_SECOND, _STEP_SECONDS = 1e11, 1e-4
"""A fast core: operations of its matrix products per second, and the rest of a step."""

_FASTER = 1.1
"""How much faster a process on each core is than the threads of one process; see the table in
experiments/results/benchmarks/process_per_core.md."""

_START_SECONDS, _COMPILE_SECONDS = 8.0, 10.0


@dataclasses.dataclass(frozen=True)
class Shares:
    """The division of the cores among processes.

    Attributes:
        cores: the cores of each process, to which it is pinned; empty where the system cannot pin.
        lanes: largest number of lanes that a process trains at a time: one for each of its cores.
        reason: why there is one process, in a few words; empty for several.
    """

    cores: tuple[tuple[int, ...], ...]
    lanes: int = 1
    reason: str = ""

    @property
    def processes(self) -> int:
        """Number of processes; with one, this process trains the lanes with threads."""
        return len(self.cores)

    def __str__(self) -> str:
        if self.processes == 1:
            return f"one process with a thread per core ({self.reason})"
        pinned = ", each pinned to its share of the cores" if self.cores[0] else ""
        return f"{self.processes} processes{pinned}"


def shares_of(processes: int | None, jobs: Sequence[Job], strategy: str, shell: bool) -> Shares:
    """The division of the cores for the lanes that wait.

    Several processes are chosen without being asked for only if all of these hold: the command was
    given in a shell, on CPUs whose cores the system can assign, with the strategy ``map``; the
    memory is enough; and the estimated time with them is shorter, and at least `LEAST_SECONDS`.

    Args:
        processes: the number that the user wants; None to choose it.
        jobs: the lanes that wait.
        strategy: ``map`` or ``vmap``.
        shell: whether the command was given in a shell. Another program may have registered
            environments that a new process does not have.

    Raises:
        UserError: when the number that the user wants is impossible.
    """
    if processes is None:
        reason = _why_threads(jobs, strategy, shell)
        return _threads(reason) if reason else _divided(cores())
    if processes == 1 or not jobs:
        return _threads("--processes 1" if processes == 1 else "no lane waits")
    if strategy != "map" or workers()[0].platform != "cpu":
        raise UserError(
            f"--processes {processes} divides the cores of a CPU, on which lanes are trained one "
            "by one: leave it out, or add --device cpu --strategy map"
        )
    if processes > cores():
        raise UserError(
            f"--processes {processes}: this process may use {cores()} cores; give at most as many"
        )
    shares = _divided(min(processes, len(jobs)))
    needed, limit = processes_bytes(jobs, shares.processes, shares.lanes), memory_limit()
    if needed > limit:
        raise UserError(
            f"--processes {processes} needs {needed / 2**30:,.1f} GiB, but there are only "
            f"{limit / 2**30:,.1f}; use fewer processes, or --processes 1"
        )
    return shares


def _why_threads(jobs: Sequence[Job], strategy: str, shell: bool) -> str:
    """Why the lanes stay in one process; empty if several are better."""
    count = cores()
    quota = core_quota()
    if workers()[0].platform != "cpu" or strategy != "map" or len(workers()) != count:
        return "several are for the cores of a CPU"
    if not hasattr(os, "sched_setaffinity"):
        return "this system cannot pin a process to a core"
    if not shell:
        return "the command was not given in a shell"
    if count < 2 or (quota is not None and quota < count):
        return "there is one core" if count < 2 else "the container has less time than its cores"
    if len(jobs) < count:
        return "fewer lanes wait than there are cores"
    seconds = [lane_seconds(job.cell.config) for job in jobs]
    if sum(seconds) / count < LEAST_SECONDS:
        return "a short study"
    if processes_bytes(jobs, count, 1) > memory_limit():
        return "the memory is not enough for several"
    if _apart(jobs, seconds, count) >= _together(jobs, seconds, count):
        return "some cores would be idle at the end"
    return ""


def lane_seconds(config: Config) -> float:
    """Estimated seconds of a fast core for a lane, from the operations of its updates."""
    learning = config.total_steps - config.learning_starts
    return learning * (update_flops(config) / _OPERATIONS_A_SECOND + _STEP_SECONDS)


def _together(jobs: Sequence[Job], seconds: Sequence[float], count: int) -> float:
    """Estimated seconds with threads, which keep all cores busy to the end."""
    return sum(seconds) / count + _COMPILE_SECONDS * len({job.program for job in jobs})


def _apart(jobs: Sequence[Job], seconds: Sequence[float], count: int) -> float:
    """Estimated seconds with processes, each of which trains one lane after the other."""
    free, compiled = [_START_SECONDS] * count, [set[object]() for _ in range(count)]
    for job, lane in zip(jobs, seconds, strict=True):
        first = free.index(min(free))
        new = job.program not in compiled[first]
        compiled[first].add(job.program)
        free[first] += lane / _FASTER + new * _COMPILE_SECONDS
    return max(free)


def _threads(reason: str) -> Shares:
    return Shares(((),), reason=reason)


def _divided(processes: int) -> Shares:
    count = cores()
    if not hasattr(os, "sched_getaffinity"):
        return Shares(((),) * processes, -(-count // processes))
    own = sorted(os.sched_getaffinity(0))  # neighbours often share a cache
    ends = [count * place // processes for place in range(processes + 1)]
    shares = (tuple(own[a:b]) for a, b in zip(ends, ends[1:], strict=False))
    return Shares(tuple(shares), -(-count // processes))
