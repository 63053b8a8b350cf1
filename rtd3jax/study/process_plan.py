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
            All processes have the same number, since rounding depends on it.
        lanes: largest number of lanes that a process trains at a time: one for each of its cores,
            but at most its share of the lanes.
    """

    cores: tuple[tuple[int, ...], ...]
    lanes: int = 1

    @property
    def processes(self) -> int:
        """Number of processes."""
        return len(self.cores)

    @property
    def here(self) -> bool:
        """Whether this process trains the lanes, with threads."""
        return self.cores == ((),)

    def __str__(self) -> str:
        if self.here:
            return "one process with a thread per core"
        count, own = self.processes, len(self.cores[0])
        each = "each " * (count > 1)
        pinned = f", {each}pinned to {own} core{'s' * (own > 1)}" if own else ""
        return f"{count} process{'es' * (count > 1)}{pinned}"


def shares_of(processes: int, jobs: Sequence[Job], strategy: str) -> Shares:
    """The division of the cores among ``processes``, for the lanes that wait.

    There are never more processes than lanes. The cores are divided by the number that the user
    wants, also if fewer lanes wait: a lane then has the same bits however many lanes wait beside
    it. Cores that are left over stay idle.

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
    needed, limit = _bytes(jobs, processes), memory_limit()
    if needed > limit:
        # Fewer processes need less; one process lets lanes wait for memory.
        fewer = next((n for n in range(processes - 1, 1, -1) if _bytes(jobs, n) <= limit), 1)
        raise UserError(
            f"--processes {processes} needs {needed / 2**30:,.1f} GiB, but there are only "
            f"{limit / 2**30:,.1f}; use --processes {fewer}, or lower replay_capacity, "
            "hidden_size, batch_size or history_length"
        )
    return _shared(processes, jobs)


def _bytes(jobs: Sequence[Job], processes: int) -> int:
    shares = _shared(processes, jobs)
    return processes_bytes(jobs, shares.processes, shares.lanes)


def _shared(processes: int, jobs: Sequence[Job]) -> Shares:
    """Equal shares of the cores, without room for more lanes than there are."""
    count, each = min(processes, len(jobs)), cores() // processes
    lanes = min(each, -(-len(jobs) // count))
    if not hasattr(os, "sched_getaffinity"):
        return Shares(((),) * count, lanes)
    own = sorted(os.sched_getaffinity(0))  # neighbours often share a cache
    return Shares(tuple(tuple(own[each * n : each * (n + 1)]) for n in range(count)), lanes)
