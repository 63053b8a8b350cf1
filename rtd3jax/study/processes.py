"""Trains the lanes of a study in several processes of this machine.

A process that is pinned to a core trains more steps per second than a thread of a process with all
cores. Its sums are rounded differently, because XLA divides sums by the number of cores that a
process may use. This process plans, gives a lane to each process that is free, shows the progress,
and writes the tables; it computes nothing meanwhile. The processes write the files of their lanes
and the log, as the tasks of a cluster do. A lane whose process was killed goes on from its
checkpoint in another process.
"""

import collections
import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rtd3jax.errors import UserError
from rtd3jax.study.cells import bar_labels
from rtd3jax.study.crew import Crew, Member
from rtd3jax.study.derive import Reference
from rtd3jax.study.execute import (
    Work,
    checkpoints_of,
    forget_errors,
    prepare_files,
    waiting_jobs,
)
from rtd3jax.study.interim import InterimResults
from rtd3jax.study.log import LOG, repair_log
from rtd3jax.study.log_reader import LogReader
from rtd3jax.study.loggers import Logger
from rtd3jax.study.process_plan import Shares
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.training.grouping import make_groups
from rtd3jax.training.groups import Group
from rtd3jax.training.jobs import Job
from rtd3jax.training.progress import Progress

_POLL_SECONDS = 0.3
_END_SECONDS = 10.0
_ATTEMPTS = 3
"""A lane fails when this number of processes ended while they trained it; the training fails when
this number of processes ended at their start."""


def train_in_processes(
    directory: RunDirectory,
    jobs: Sequence[Job],
    work: Work,
    complaints: list[str],
    references: Sequence[Reference],
    logger: Logger | None,
    shares: Shares,
    imports: Sequence[str],
    handles: Sequence[int] = (),
) -> None:
    """Train the lanes that have not ended, in a process for each share of the cores.

    Args:
        directory: the run directory.
        jobs: all lanes of the run.
        work: options of the training.
        complaints: list to which a line is added for each lane that fails.
        references: policies without training, for the interim tables.
        logger: the trackers, to which this process sends rows.
        shares: the division of the cores.
        imports: modules that register environments.
        handles: the locks of the run directory, which each process holds too.

    Raises:
        UserError: when a process cannot be started, make an environment, or write.
    """
    waiting = waiting_jobs(directory, jobs)
    if not waiting:
        return
    prepare_files(directory, waiting, checkpoints_of(directory, work.interval))
    forget_errors(directory, waiting)
    repair_log(directory.path / LOG)
    inner = dataclasses.replace(work, quiet=True, at_once=shares.lanes, began=time.perf_counter())
    settings = {
        "path": str(directory.path.resolve()),
        "imports": list(imports),
        "work": dataclasses.asdict(inner),
    }
    log = LogReader(directory, logger)
    interim = InterimResults(directory, references, page=work.page)
    groups = make_groups(waiting, work.strategy, 1)
    try:
        with (
            Progress(groups, bar_labels(waiting), enabled=not work.quiet) as bar,
            Crew(shares.cores, settings, handles) as crew,
        ):
            study = _Study(directory, groups, crew, shares.lanes, complaints, bar.update)
            while study.left:
                study.give()
                ended = study.listen()
                log.steps()
                if ended:
                    study.give()  # before the tables, which take seconds
                    interim.refresh()
    finally:
        log.steps()  # sends the trackers the rows from before an interrupt


class _Study:
    """The lanes that are not trained yet, and what the processes tell of them."""

    def __init__(
        self,
        directory: RunDirectory,
        groups: Sequence[Group],
        crew: Crew,
        at_once: int,
        complaints: list[str],
        show: Callable[[Group], None],
    ) -> None:
        self._directory, self._crew, self._at_once = directory, crew, at_once
        self._complaints, self._show = complaints, show
        self._waiting = list(groups)
        places = {cell: place for place, cell in enumerate(directory.cells)}
        self._lanes = {(places[g.jobs[0].cell], g.jobs[0].seed): g for g in groups}
        self._names = {id(group): name for name, group in self._lanes.items()}
        self.left = len(groups)
        """Number of lanes that wait or are trained now."""
        self._killed: collections.Counter[int] = collections.Counter()
        self._failed_starts = 0

    def give(self) -> None:
        """Give lanes to the processes that have none."""
        for member in self._crew.members:
            if member.ready and not member.lanes and self._waiting:
                lanes = self._choose(member)
                member.order(lanes, [self._names[id(lane)] for lane in lanes])

    def _choose(self, member: Member) -> list[Group]:
        """The lanes for a process.

        Their program is the one that the process has compiled, if lanes of it wait; else one that
        no other process trains now; else the one with the most waiting lanes.
        """
        waiting: dict[Any, list[Group]] = {}
        for group in self._waiting:
            waiting.setdefault(group.jobs[0].executable, []).append(group)
        taken = {other.executable for other in self._crew.members if other.lanes}
        if member.executable in waiting:
            lanes = waiting[member.executable]
        else:
            new = [lanes for executable, lanes in waiting.items() if executable not in taken]
            lanes = new[0] if new else max(waiting.values(), key=len)
        # A lane whose process was killed may be the cause: it is trained alone.
        alone = self._killed[id(lanes[0])] > 0
        # With more cores than its share of the lanes, it would leave none for the others.
        most = min(len(member.cores) or self._at_once, self._at_once)
        chosen = lanes[: 1 if alone else most]
        self._waiting = [group for group in self._waiting if group not in chosen]
        return chosen

    def listen(self) -> bool:
        """Note what the processes tell; return whether a lane has ended."""
        before = self.left
        for member, message in self._crew.messages(_POLL_SECONDS):
            if message is None:
                self._replace(member)
            elif "error" in message:
                raise UserError(message["error"])
            elif "ended" in message:
                self.left -= len(member.lanes)
                member.lanes = []
                self._complaints += message["ended"]
            elif "lane" in message:
                group = self._lanes[tuple(message["lane"])]
                if group.returns is None:  # a later process begins at steps that were trained here
                    group.began_at = message["began_at"]
                group.step, group.returns = message["step"], np.array([message["returns"]])
                self._show(group)
            else:
                member.ready, self._failed_starts = True, 0
        return self.left < before

    def _replace(self, member: Member) -> None:
        """Let another process train the lanes of one that has ended before its time."""
        status = member.wait(_END_SECONDS)
        member.kill()  # it may only have closed its output
        how = f"signal {-status}" if status is not None and status < 0 else f"status {status}"
        self._crew.members.remove(member)
        if not member.ready:
            self._failed_starts += 1
            if self._failed_starts == _ATTEMPTS:
                raise UserError(
                    f"--processes: {_ATTEMPTS} processes ended at their start ({how}); "
                    "use --processes 1"
                )
        for group in member.lanes:
            self._killed[id(group)] += 1
            if self._directory.lanes.is_done(*group.jobs[0].key):
                self.left -= 1  # it ended before the others that the process trained
            elif self._killed[id(group)] < _ATTEMPTS:
                self._waiting.insert(0, group)
            else:
                self._fail(
                    group.jobs[0],
                    f"{_ATTEMPTS} processes ended while they trained it; "
                    f"the last with {how} (9: perhaps the memory was not enough)",
                )
        if self._waiting:
            self._crew.begin(member.cores)

    def _fail(self, job: Job, reason: str) -> None:
        self._directory.lanes.write_error(*job.key, reason)
        self._complaints.append(f"{job.cell.words} seed {job.seed} failed: {reason}")
        self.left -= 1
