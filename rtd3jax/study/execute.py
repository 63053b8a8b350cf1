"""Trains lanes of a run directory in this process."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax

from rtd3jax.errors import UserError
from rtd3jax.study.cells import bar_labels
from rtd3jax.study.derive import Reference
from rtd3jax.study.interim import InterimResults
from rtd3jax.study.log import LoggedReturns
from rtd3jax.study.loggers import Logger
from rtd3jax.study.memory_plan import lanes_in_total
from rtd3jax.study.recorder import Recorder
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.starts import add_starts
from rtd3jax.training.checkpoint import Checkpoints
from rtd3jax.training.devices import workers
from rtd3jax.training.grouping import make_groups
from rtd3jax.training.groups import Group
from rtd3jax.training.jobs import Job
from rtd3jax.training.lanes import advance_groups
from rtd3jax.training.plant import MOST_NUMBERS, named_numbers
from rtd3jax.training.progress import Progress


@dataclasses.dataclass(frozen=True)
class Work:
    """Options of the training of lanes.

    Attributes:
        strategy: ``map`` or ``vmap``; see `rtd3jax.training.groups`.
        at_once: number of lanes that fit in memory; under ``vmap``, in the memory of a device.
        interval: (seconds, steps) between checkpoints of a lane; with (None, None), it is five
            minutes, or longer if a checkpoint takes long.
        quiet: whether to omit the progress bar and remarks.
        page: whether to write the page of the run.
        workers: maximum number of workers; all workers by default.
        keep: whether to keep the last checkpoint of a lane that has ended, so that the lane can
            continue to more steps later.
        began: the value of `time.perf_counter` from which the log counts seconds, which is the same
            clock in all processes of a machine; the start of the training by default.
    """

    strategy: str
    at_once: int
    interval: tuple[float | None, int | None] = (None, None)
    quiet: bool = False
    page: bool = True
    workers: int | None = None
    keep: bool = False
    began: float | None = None


def train_here(
    directory: RunDirectory,
    jobs: Sequence[Job],
    work: Work,
    complaints: list[str],
    references: Sequence[Reference] | None = None,
    logger: Logger | None = None,
    watch: Callable[[Group], None] = lambda group: None,
    logged: LoggedReturns | None = None,
) -> None:
    """Train the lanes that have not ended; add a line to ``complaints`` for each that fails.

    With ``references``, tables and page are updated about once a minute. ``watch`` is called after
    each chunk is recorded; if it raises KeyboardInterrupt, the lanes write their checkpoints.
    A process that trains lanes several times passes the same ``logged`` each time, so that it reads
    each line of the log once.
    """
    waiting = waiting_jobs(directory, jobs)
    checkpoints = checkpoints_of(directory, work.interval)
    prepare_files(directory, waiting, checkpoints)
    add_starts(directory, waiting, write=True)
    forget_errors(directory, waiting)
    devices = workers()[: work.workers]
    in_total = lanes_in_total(work.at_once, work.strategy, len(devices))
    if in_total < len(waiting) and not work.quiet:
        each = " of each device" if in_total > work.at_once else ""
        print(f"the memory is enough for {work.at_once:,} lanes{each}: the others wait")
    groups = make_groups(waiting, work.strategy, len(devices), work.at_once, checkpoints)
    interim = None if references is None else InterimResults(directory, references, page=work.page)
    recorder = Recorder(
        directory,
        checkpoints,
        interim,
        logger,
        complaints,
        keep=work.keep,
        began=work.began,
        logged=logged,
    )
    with Progress(groups, bar_labels(waiting), enabled=not work.quiet) as bar:

        def on_chunk(group: Group) -> None:
            bar.update(group)
            recorder.update(group)
            watch(group)

        advance_groups(groups, on_chunk, checkpoints, devices)


def planned_jobs(directory: RunDirectory, strategy: str, *, fresh: bool = False) -> list[Job]:
    """A job with its start for each lane of the study; nothing is written.

    Raises:
        UserError: as `add_starts` does, or when a lane that gets more steps cannot continue from
            its checkpoint. Once the study is extended, the lanes that ended before count as
            unfinished, and the tables do not have them any more.
    """
    jobs = directory.jobs(strategy)
    add_starts(directory, jobs, write=False, fresh=fresh)
    longer = [] if fresh else directory.longer()
    checkpoints = checkpoints_of(directory, (None, None))
    for job in jobs:
        if job.cell in longer:
            try:
                checkpoints.check(job, whole=True)
            except UserError as error:
                raise UserError(
                    f"--out {directory.path}: {job.cell.words} seed {job.seed} cannot continue to "
                    f"{job.cell.config.total_steps:,} steps: {error}"
                ) from error
    return jobs


def waiting_jobs(directory: RunDirectory, jobs: Sequence[Job]) -> list[Job]:
    """The jobs of lanes that have not ended; the number of ended lanes is printed."""
    waiting = [job for job in jobs if not directory.lanes.is_done(*job.key)]
    if len(waiting) < len(jobs):
        print(f"{len(jobs) - len(waiting)} of {len(jobs)} lanes have ended already")
    return waiting


def prepare_files(directory: RunDirectory, jobs: Sequence[Job], checkpoints: Checkpoints) -> None:
    """Make the directories of the lanes' files and checkpoints, before hours of training.

    Raises:
        UserError: when one of them cannot be written.
    """
    for cell in dict.fromkeys(job.cell for job in jobs):
        directory.lanes.prepare(cell)
    checkpoints.prepare(jobs)


def forget_errors(directory: RunDirectory, jobs: Iterable[Job]) -> None:
    """Remove the reasons why lanes failed before, because they are trained now."""
    for job in jobs:
        directory.lanes.error_path(*job.key).unlink(missing_ok=True)


def checkpoints_of(
    directory: RunDirectory, interval: tuple[float | None, int | None]
) -> Checkpoints:
    """The checkpoints of a run: the directory and the identity of each lane."""

    def identity(job: Job) -> dict[str, Any]:
        cell, seed = job.key
        found = {**cell.to_dict(), "seed": seed, "window": job.program.window_tokens}
        # The name of a disturbance does not identify a recording: its file may have changed.
        large = [leaf for leaf in jax.tree.leaves(job.lane.env_params) if leaf.size > MOST_NUMBERS]
        # The recording comes first, so that an error message names it before other differences.
        return {"recorded": [named_numbers(leaf) for leaf in large], **found} if large else found

    return Checkpoints(
        lambda job: directory.lanes.checkpoint_directory(*job.key), identity, *interval
    )
