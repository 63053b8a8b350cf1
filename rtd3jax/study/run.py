"""Runs a study: trains the lanes that are missing, then writes tables, pictures and the page."""

import contextlib
from collections.abc import Callable, Sequence

from rtd3jax.study.execute import Work, train_here
from rtd3jax.study.finish import finish
from rtd3jax.study.lock import writer
from rtd3jax.study.loggers import open_loggers
from rtd3jax.study.references import references_of
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.training.jobs import Job

Trainer = Callable[..., None]
"""`train_here`, or another function with the same arguments."""


def run_study(
    directory: RunDirectory,
    jobs: list[Job],
    work: Work,
    *,
    log: Sequence[str] = (),
    shard: tuple[int, int] | None = None,
    share: Callable[[list[Job]], list[Job]] = lambda jobs: jobs,
    trainer: Callable[[list[int]], Trainer] = lambda handles: train_here,
) -> tuple[list[str], KeyboardInterrupt | None]:
    """Train the lanes of a run directory that have not ended, and write its results.

    Args:
        directory: the run directory, after `RunDirectory.prepare`.
        jobs: a job for each lane of the study, also for those that have ended.
        work: options of the training.
        log: names of trackers.
        shard: number of this shard and number of shards, if several processes divide the lanes.
        share: chooses the lanes of this process.
        trainer: makes the function that trains, from the handles of the locks that are held.

    Returns:
        A line for each lane that was lost or failed; and the interrupt that ended the training, or
        None.
    """
    complaints: list[str] = []
    interrupt: KeyboardInterrupt | None = None
    with contextlib.ExitStack() as held:
        handles = held.enter_context(writer(directory.path, shard))
        if directory.refresh():  # another process has changed the study in the meantime
            jobs = directory.jobs(work.strategy)
        jobs, references = share(jobs), references_of(directory.cells)
        train, ended = trainer(handles), False
        try:
            with open_loggers(log, directory) as logger:
                train(directory, jobs, work, complaints, references, logger)
            ended = True
        except KeyboardInterrupt as caught:
            interrupt = caught
        finally:
            held.close()  # else the page shows lanes that were interrupted as running
            finish(directory, references, page=work.page, interrupted=not ended)
    return complaints, interrupt
