"""Divides the cores of this machine among the processes that train the lanes of a study."""

import dataclasses
import os
from collections.abc import Sequence

from rtd3jax.errors import UserError
from rtd3jax.study.memory_plan import processes_bytes
from rtd3jax.system.machine import cores, memory_limit
from rtd3jax.training.devices import workers
from rtd3jax.training.jobs import Job


@dataclasses.dataclass(frozen=True)
class Shares:
    """The division of the cores among processes.

    Attributes:
        cores: the cores of each process, to which it is pinned; empty where the system cannot pin.
        lanes: largest number of lanes that a process trains at a time: one for each of its cores,
            but at most its share of the lanes.
    """

    cores: tuple[tuple[int, ...], ...]
    lanes: int = 1

    @property
    def processes(self) -> int:
        """Number of processes; with one, this process trains the lanes with threads."""
        return len(self.cores)

    def __str__(self) -> str:
        if self.processes == 1:
            return "one process with a thread per core"
        pinned = ", each pinned to its share of the cores" if self.cores[0] else ""
        return f"{self.processes} processes{pinned}"


def shares_of(processes: int, jobs: Sequence[Job], strategy: str) -> Shares:
    """The division of the cores among ``processes``, for the lanes that wait.

    There are never more processes than lanes.

    Args:
        processes: the number that the user wants.
        jobs: the lanes that wait.
        strategy: ``map`` or ``vmap``.

    Raises:
        UserError: when the number that the user wants is impossible.
    """
    if processes == 1 or not jobs:
        return Shares(((),))
    if strategy != "map" or workers()[0].platform != "cpu":
        raise UserError(
            f"--processes {processes} divides the cores of a CPU, on which lanes are trained one "
            "by one: leave it out, or add --device cpu --strategy map"
        )
    if processes > cores():
        raise UserError(
            f"--processes {processes}: this process may use {cores()} cores; give at most as many"
        )
    count = min(processes, len(jobs))
    if count == 1:
        return Shares(((),))
    needed, limit = _bytes(jobs, count), memory_limit()
    if needed > limit:
        # Fewer processes train as many lanes at a time; one process lets lanes wait for memory.
        fewer = next((n for n in range(count - 1, 1, -1) if _bytes(jobs, n) <= limit), 1)
        raise UserError(
            f"--processes {processes} needs {needed / 2**30:,.1f} GiB, but there are only "
            f"{limit / 2**30:,.1f}; use --processes {fewer}, or lower replay_capacity, "
            "hidden_size, batch_size or history_length"
        )
    return _shared(count, jobs)


def _bytes(jobs: Sequence[Job], processes: int) -> int:
    return processes_bytes(jobs, processes, _shared(processes, jobs).lanes)


def _shared(processes: int, jobs: Sequence[Job]) -> Shares:
    """The division of all cores among the processes, without room for more lanes than there are."""
    shares = _divided(processes)
    return dataclasses.replace(shares, lanes=min(shares.lanes, -(-len(jobs) // processes)))


def _divided(processes: int) -> Shares:
    count = cores()
    if not hasattr(os, "sched_getaffinity"):
        return Shares(((),) * processes, -(-count // processes))
    own = sorted(os.sched_getaffinity(0))  # neighbours often share a cache
    ends = [count * place // processes for place in range(processes + 1)]
    shares = (tuple(own[a:b]) for a, b in zip(ends, ends[1:], strict=False))
    return Shares(tuple(shares), -(-count // processes))
