"""``python -m rtd3jax.sweep``: train every cell of a study, and write its results.

A cell is an algorithm under a disturbance with a history length. A lane is the training of one seed
of a cell. If you repeat the command, it trains the lanes that are missing; with more seeds, cells
or steps, it also trains those.
"""

import argparse
import collections
import dataclasses
import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from rtd3jax.cli import sweep_options
from rtd3jax.cli.common import exit_status
from rtd3jax.errors import UserError
from rtd3jax.study.cells import make_cells
from rtd3jax.study.cluster import check_absolute_starts, train_on_cluster
from rtd3jax.study.execute import Work, planned_jobs, train_here, waiting_jobs
from rtd3jax.study.hosts import own_shard, own_share, relaunch
from rtd3jax.study.lane_files import check_names
from rtd3jax.study.lock import parse_shard, writer
from rtd3jax.study.loggers import check_loggers
from rtd3jax.study.memory_plan import lanes_at_once, usable_memory
from rtd3jax.study.plan import plan_text
from rtd3jax.study.process_plan import Shares, shares_of
from rtd3jax.study.processes import train_in_processes
from rtd3jax.study.run import Trainer, run_study
from rtd3jax.study.rundir import RunDirectory, holds_study
from rtd3jax.study.starts import check_starts_stay
from rtd3jax.study.status import ledger
from rtd3jax.system.imports import import_modules
from rtd3jax.system.interrupts import Terminated, terminable
from rtd3jax.training.arguments import check_strategy
from rtd3jax.training.devices import workers
from rtd3jax.training.jobs import Job


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status.

    0: done. 1: lanes were lost or failed. 2: bad input. 130: interrupted. 143: terminated by
    SIGTERM, which a batch system sends before SIGKILL.
    """
    try:
        options = sweep_options.parser(__doc__).parse_args(arguments)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    with terminable():
        # Interrupts during the training do not arrive here: `run_study` handles them.
        return exit_status(
            lambda: _start(options, arguments), lambda: sweep_options.out(options), _status_of
        )


def _start(options: argparse.Namespace, arguments: Sequence[str] | None) -> int:
    import_modules(options.imports)
    if options.distributed and not jax.distributed.is_initialized():
        relaunch("rtd3jax.sweep", arguments)
    if options.device:
        jax.config.update("jax_default_device", sweep_options.device(options.device))
    return _run(options)


def _status_of(interrupt: KeyboardInterrupt) -> int:
    return 143 if isinstance(interrupt, Terminated) else 130


def _run(options: argparse.Namespace) -> int:
    if options.status:
        return _status(sweep_options.out(options))
    plan = _plan(options)
    return _dry_run(plan, options) if options.dry_run else _train(plan, options)


@dataclasses.dataclass(frozen=True)
class _Plan:
    """What the command will do.

    Attributes:
        directory: the run directory, in which nothing is written yet.
        jobs: a job for each lane of the study, also for those that have ended.
        strategy: ``map`` or ``vmap``.
        interval: (seconds, steps) between checkpoints.
        shard: the share of this process, if the lanes are divided by ``--shard``.
        shares: how processes of this machine divide the lanes.
        additions: a message about what is added to an existing study.
    """

    directory: RunDirectory
    jobs: list[Job]
    strategy: str
    interval: tuple[float | None, int | None]
    shard: tuple[int, int] | None
    shares: Shares
    additions: str


def _plan(options: argparse.Namespace) -> _Plan:
    """Read the options; all that is wrong with them raises UserError before a file is written."""
    cells = make_cells(sweep_options.grids(options), sweep_options.overrides(options))
    seeds = list(range(sweep_options.count("seeds", options.seeds)))
    episodes = sweep_options.count("final_episodes", options.final_episodes)
    strategy = check_strategy(options.strategy)
    check_loggers(options.log)
    if options.cluster == "":
        raise UserError("--cluster is empty: name an address (host:port) or auto, or leave it out")
    if options.start == "":
        raise UserError("--start is empty: name a run or a policy's file, or leave it out")
    processes = sweep_options.count("processes", options.processes)
    if sum(map(bool, (*_divided(options), processes > 1))) > 1:
        raise UserError(
            "--processes, --shard, --distributed and --cluster each divide the lanes among "
            "processes: choose one of them"
        )
    if options.fresh and (options.shard or options.distributed):
        raise UserError(
            "--fresh renames DIR, which several processes must not do: rename it once, then start "
            "them without --fresh"
        )
    out = sweep_options.out(options)
    directory = RunDirectory(out, cells, seeds, episodes)
    if options.fresh:
        check_names(cells)  # `plan` checks them otherwise
        if holds_study(out):
            check_starts_stay(cells, out)
    if options.cluster:
        check_absolute_starts(cells)
    additions = "" if options.fresh else directory.plan()
    jobs = planned_jobs(directory, strategy, fresh=options.fresh)
    waiting = [job for job in jobs if options.fresh or not directory.lanes.is_done(*job.key)]
    shares = shares_of(processes, waiting, strategy)
    interval = sweep_options.parse_interval(options.checkpoint_every)
    shard = _shard(options)
    return _Plan(directory, jobs, strategy, interval, shard, shares, additions)


def _divided(options: argparse.Namespace) -> tuple[Any, ...]:
    """The options that divide the lanes among processes of several machines."""
    return options.shard, options.distributed, options.cluster


def _dry_run(plan: _Plan, options: argparse.Namespace) -> int:
    """Print the plan."""
    directory, memory = plan.directory, usable_memory()
    say = functools.partial(print, file=sys.stderr, flush=True)
    jobs = plan.jobs
    if not options.fresh:
        jobs = waiting_jobs(directory, jobs)
    if jobs:
        print(plan_text(directory.cells, directory.seeds, jobs, plan.strategy, memory, say))
        if not any(_divided(options)):
            print(f"trained by {plan.shares}")
    print(plan.additions, end="\n" if plan.additions else "")
    return 0


def _train(plan: _Plan, options: argparse.Namespace) -> int:
    """Train the lanes of the plan, and write the results."""
    directory, jobs = plan.directory, plan.jobs
    if options.cluster:  # the nodes of the cluster need the memory, not this machine
        at_once = len(jobs)
    else:
        at_once = lanes_at_once(jobs, plan.strategy, len(workers()), usable_memory())
    if options.fresh:
        _set_aside(directory.path)
    if additions := directory.prepare():
        print(additions)
    work = Work(
        plan.strategy,
        at_once,
        plan.interval,
        quiet=options.quiet,
        page=options.report,
        keep=options.keep_checkpoints,
    )
    complaints, interrupt = run_study(
        directory,
        jobs,
        work,
        log=options.log,
        shard=plan.shard,
        share=functools.partial(_share, shard=plan.shard, options=options),
        trainer=functools.partial(_trainer, options, plan.shares),
    )
    return _conclude(directory, complaints, _status_of(interrupt) if interrupt else 0)


def _shard(options: argparse.Namespace) -> tuple[int, int] | None:
    if options.distributed:
        return own_shard()
    return None if options.shard is None else parse_shard(options.shard)


def _share(
    jobs: list[Job], shard: tuple[int, int] | None, options: argparse.Namespace
) -> list[Job]:
    """The lanes of this process.

    A shard has every n-th lane, so that all shards take about the same time.
    """
    if options.distributed:
        return own_share(jobs)
    return jobs if shard is None else jobs[shard[0] - 1 :: shard[1]]


def _trainer(options: argparse.Namespace, shares: Shares, handles: list[int]) -> Trainer:
    """The function that trains the lanes: on a cluster, in several processes, or in this one."""
    if options.cluster:
        where = {"address": options.cluster, "imports": options.imports}
        return functools.partial(train_on_cluster, **where)
    if shares.here:
        return train_here
    where = {"shares": shares, "imports": options.imports, "handles": handles}
    return functools.partial(train_in_processes, **where)


def _conclude(directory: RunDirectory, complaints: Sequence[str], interrupted: int) -> int:
    """Print the summary, and what was lost; return the exit status."""
    print((directory.path / "summary.md").read_text("utf-8"))
    print(f"results: {directory.path}")
    if interrupted:
        print("interrupted: repeat the command to train the lanes that are missing")
        return interrupted
    for line in complaints:
        print(line, file=sys.stderr)
    ended_badly = sum(row["status"] in ("lost", "failed") for row in ledger(directory))
    if ended_badly and not complaints:
        print(
            f"{ended_badly} lanes were lost or failed before: --status says why; remove the files "
            f"of lost lanes from {directory.path / 'lanes'} to train them again",
            file=sys.stderr,
        )
    return 1 if complaints or ended_badly else 0


def _set_aside(out: Path) -> None:
    """Rename a run directory, so that its lanes are kept."""
    if not holds_study(out):
        return
    if Path.cwd().is_relative_to(out.resolve()):
        raise UserError(
            f"--fresh would rename {out.resolve()}, which is the working directory or holds it: "
            "start the command from outside"
        )
    if out.is_symlink():
        raise UserError(
            f"{out} is a link, and --fresh renames a directory: give --out {out.resolve()}"
        )
    with writer(out, None):
        for number in range(1, 10_000):
            aside = out.with_name(f"{out.name}.old-{number}")
            if not aside.exists():
                out.rename(aside)
                print(f"the previous run directory is now {aside}")
                return


def _status(out: Path) -> int:
    directory = RunDirectory.open(out)
    lanes = ledger(directory)
    for row in lanes:
        length = f"l={row['history_length']}"
        print(
            f"{row['env']:10} {row['disturbance']:24} {row['algorithm']:20} {length:5} "
            f"seed {row['seed']:<4} {row['status']:9} {row['step']:>10,}  {row['reason']}"
        )
    counts = collections.Counter(row["status"] for row in lanes)
    print(", ".join(f"{count} {status}" for status, count in counts.items()))
    return 1 if counts["failed"] or counts["lost"] else 0
