"""``python -m rtd3jax.sweep``: train every cell of a study, and write down what came out.

A cell is an algorithm under a disturbance with a history length; its seeds are trained side by
side. The same command again trains what is missing.
"""

import argparse
import collections
import dataclasses
import importlib
import json
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import jax
import numpy as np

from rtd3jax.config import ALGORITHMS, Config
from rtd3jax.envs.registry import DISTURBANCES, ENVIRONMENTS
from rtd3jax.errors import UserError
from rtd3jax.evaluate import evaluate
from rtd3jax.policy import constant_policy, random_policy
from rtd3jax.study.lock import parse_shard, writer
from rtd3jax.study.memory import lanes_at_once
from rtd3jax.study.plan import PRESETS, Cell, Grid, cell_jobs, estimate, make_cells
from rtd3jax.study.rundir import LOG, Reference, RunDirectory
from rtd3jax.training.checkpoint import Checkpoints
from rtd3jax.training.lanes import Group, Job, advance_groups, make_groups, workers
from rtd3jax.training.progress import Progress
from rtd3jax.training.run import check_strategy, curves_of, evaluation_steps, failure_of

REFERENCE_EPISODES = 1_000
_EARLY_ANSWERS_SECONDS = 60.0
"""At most so often are tables and pictures made while the sweep runs."""

_GRID_FIELDS = ("algorithm", "history_length")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit status.

    0 done, 1 lanes were lost or failed, 2 bad input, 130 interrupted, 143 asked to terminate (as a
    batch system does before it kills).
    """
    try:
        options = _parser().parse_args(arguments)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    before = _on_termination(_terminate)
    try:
        for module in options.imports:
            _import(module)
        if options.device:
            jax.config.update("jax_default_device", _device(options.device))
        return _run(options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        # A full disk, say. What was written before is whole, and the same command goes on from it.
        print(f"error: {error.filename or _out(options)}: {error.strerror}", file=sys.stderr)
        return 2
    finally:
        _on_termination(before)


class _Terminated(KeyboardInterrupt):
    """SIGTERM: lanes write their checkpoints, as after Ctrl-C."""


def _terminate(*_: Any) -> None:
    raise _Terminated


def _on_termination(handler: Any) -> Any:
    """Set SIGTERM's handler; the one before. Only the main thread may."""
    if threading.current_thread() is not threading.main_thread():
        return None
    return signal.signal(signal.SIGTERM, handler)


def _run(options: argparse.Namespace) -> int:
    if options.status:
        return _status(_out(options))
    cells = make_cells(_grids(options), _overrides(options))
    seeds = list(range(_count("seeds", options.seeds)))
    episodes = _count("final_episodes", options.final_episodes)
    strategy = check_strategy(options.strategy)
    jobs = cell_jobs(cells, seeds, strategy)
    if options.dry_run:
        print(_plan_text(cells, seeds, jobs, strategy))
        return 0
    at_once = lanes_at_once(jobs, strategy, len(workers()), _memory())
    out = _out(options)
    shard = None if options.shard is None else parse_shard(options.shard)
    if options.fresh:
        _set_aside(out)
    directory = RunDirectory(out, cells, seeds, episodes)
    checkpoints = _checkpoints(directory, options.checkpoint_every)
    with writer(directory.path, shard):
        share = _share(jobs, shard)
        return _train(directory, share, (strategy, at_once), checkpoints, options.quiet)


def _share(jobs: list[Job], shard: tuple[int, int] | None) -> list[Job]:
    """A shard's lanes: every n-th, so that the shares cost about the same."""
    return jobs if shard is None else jobs[shard[0] - 1 :: shard[1]]


def _train(
    directory: RunDirectory,
    jobs: list[Job],
    how: tuple[str, int],
    checkpoints: Checkpoints,
    quiet: bool,
) -> int:
    waiting = [job for job in jobs if not directory.is_done(*job.owner)]
    if len(waiting) < len(jobs):
        print(f"{len(jobs) - len(waiting)} of {len(jobs)} lanes are there already")
    for job in waiting:
        directory.error_path(*job.owner).unlink(missing_ok=True)
    interrupted = 0
    strategy, at_once = how
    if at_once < len(waiting) and not quiet:
        print(f"memory for {at_once:,} lanes at once: the others wait for their turn")
    groups = make_groups(waiting, strategy, len(workers()), at_once)
    references = [r for cell in _worlds(directory.cells) for r in _references(cell)]
    recorder = _Recorder(directory, checkpoints, references)
    try:
        with Progress(groups, _label, enabled=not quiet) as bar:

            def on_chunk(group: Group) -> None:
                bar.update(group)
                recorder.update(group)

            advance_groups(groups, on_chunk, checkpoints)
    except KeyboardInterrupt as interrupt:
        interrupted = 143 if isinstance(interrupt, _Terminated) else 130
    directory.derive(references)
    print((directory.path / "summary.md").read_text())
    print(f"results: {directory.path}")
    if interrupted:
        print("interrupted: the same command goes on with the lanes that are missing")
        return interrupted
    for line in recorder.complaints:
        print(line, file=sys.stderr)
    return 1 if recorder.complaints else 0


class _Recorder:
    """Writes lanes down as they end, and the log as they go."""

    def __init__(
        self, directory: RunDirectory, checkpoints: Checkpoints, references: list[Reference]
    ):
        self._directory = directory
        self._checkpoints = checkpoints
        self._references = references
        self._derived = time.perf_counter()
        self._logged: dict[int, int] = {}
        self._there = directory.repair_log()
        self._began = time.perf_counter()
        self.complaints: list[str] = []

    def update(self, group: Group) -> None:
        if group.error is not None:
            reason = str(group.error).splitlines()[0] if str(group.error) else repr(group.error)
            for job in group.jobs:
                cell, seed = job.owner
                self._directory.write_error(cell, seed, reason)
                self.complaints.append(f"{_label(job)} seed {seed} failed: {reason}")
            return
        self._log(group)
        # An event may be read late, after the one that already kept the group.
        if group.finished and group.state is not None:
            for job, state in group.lanes():
                self._keep(job, state)
                self._checkpoints.discard(job)
            group.state = None  # its replay is no longer needed
            if time.perf_counter() - self._derived > _EARLY_ANSWERS_SECONDS:
                self._directory.derive(self._references)
                self._derived = time.perf_counter()

    def _log(self, group: Group) -> None:
        assert group.returns is not None
        with (self._directory.path / LOG).open("a") as log:
            for index, job in enumerate(group.jobs):
                cell, seed = job.owner
                curve, steps = group.returns[index], evaluation_steps(cell.config)
                reached = int(np.sum(steps <= group.step))
                for k in range(self._logged.get(id(job), 0), reached):
                    lane = {**cell.key, "seed": seed, "step": int(steps[k])}
                    if tuple(lane.values()) in self._there:
                        continue  # the lane went on from a checkpoint before this evaluation
                    row = {
                        **lane,
                        "return": _json_number(curve[k]),
                        "seconds": round(time.perf_counter() - self._began, 3),
                    }
                    log.write(json.dumps(row) + "\n")
                self._logged[id(job)] = reached

    def _keep(self, job: Job, state: Any) -> None:
        cell, seed = job.owner
        failure = failure_of(seed, state)
        returns, true_returns = curves_of(cell.config, state, failure)
        final = np.full((2, self._directory.episodes), np.nan, np.float32)
        if failure is None:
            policy = job.program.policy(job.lane, state.learner.actor)
            final = np.stack(_both_returns(policy, cell.make_env(), self._directory.episodes, seed))
        else:
            self.complaints.append(
                f"{_label(job)} seed {seed} was lost at step {failure.step}: {failure.reason}"
            )
        self._directory.write_lane(
            cell,
            seed,
            state.learner.actor,
            {
                "steps": evaluation_steps(cell.config),
                "returns": returns,
                "true_returns": true_returns,
                "final_returns": final[0],
                "final_true_returns": final[1],
            },
            None if failure is None else {"step": failure.step, "reason": failure.reason},
        )


def _checkpoints(directory: RunDirectory, every: str) -> Checkpoints:
    seconds, steps = _parse_interval(every)

    def identity(job: Job) -> dict[str, Any]:
        cell, seed = job.owner
        return {**cell.to_dict(), "seed": seed, "window": job.program.tokens}

    return Checkpoints(
        lambda job: directory.checkpoint_directory(*job.owner), identity, seconds, steps
    )


def _parse_interval(text: str) -> tuple[float | None, int | None]:
    """``"300s"``, ``"5m"`` or ``"2000steps"`` as (seconds, None) or (infinity, steps)."""
    if text == "auto":
        return None, None
    match = re.fullmatch(r"(\d{1,9})\s*(s|m|h|steps)?", text.strip())
    if match is None or int(match[1]) < 1:
        raise UserError(f"--checkpoint-every {text!r} is not like 300s, 5m, 1h or 2000steps")
    if match[2] == "steps":
        return math.inf, int(match[1])
    return float(match[1]) * {"m": 60, "h": 3600}.get(match[2], 1), None


def _set_aside(out: Path) -> None:
    """Move a run directory away: what was trained is kept under another name."""
    if not (out / "config.json").exists():
        return
    with writer(out, None):
        for number in range(1, 10_000):
            aside = out.with_name(f"{out.name}.old-{number}")
            if not aside.exists():
                out.rename(aside)
                print(f"what was there is now {aside}")
                return


def _status(out: Path) -> int:
    directory = RunDirectory.open(out)
    ledger = directory.ledger()
    for row in ledger:
        length = f"l={row['history_length']}"
        print(
            f"{row['env']:10} {row['disturbance']:24} {row['algorithm']:20} {length:5} "
            f"seed {row['seed']:<4} {row['status']:9} {row['step']:>10,}  {row['reason']}"
        )
    counts = collections.Counter(row["status"] for row in ledger)
    print(", ".join(f"{count} {status}" for status, count in counts.items()))
    return 1 if counts["failed"] or counts["lost"] else 0


def _both_returns(policy: Any, env: Any, episodes: int, seed: int) -> list[np.ndarray]:
    return [
        np.asarray(evaluate(policy, env, episodes, seed, true_reward=true))
        for true in (False, True)
    ]


def _worlds(cells: Sequence[Cell]) -> list[Cell]:
    """One cell of each environment and disturbance."""
    return list({(cell.env, cell.disturbance): cell for cell in cells}.values())


def _references(cell: Cell) -> list[Reference]:
    """The policies that need no training: uniform random, and the rover's constant command."""
    env = cell.make_env()
    policies: dict[str, Any] = {"random": random_policy(env)}
    if cell.env == "rover":
        params = env.default_params
        params = getattr(params, "env", params)  # of a rover with faults
        policies["constant"] = constant_policy([params.target_speed, params.target_yaw_rate])
    return [
        Reference(
            cell.env, cell.disturbance, name, *_both_returns(policy, env, REFERENCE_EPISODES, 0)
        )
        for name, policy in policies.items()
    ]


def _label(job: Job) -> str:
    cell, _ = job.owner
    length = f" l={cell.config.history_length}" if cell.config.history_length else ""
    return f"{cell.config.algorithm}{length} {cell.disturbance}"


def _plan_text(
    cells: Sequence[Cell], seeds: Sequence[int], jobs: Sequence[Job], strategy: str
) -> str:
    count = len(workers())
    cost = estimate(jobs, count)
    fit = lanes_at_once(jobs, strategy, count, _memory())
    waits = f"; {len(jobs) - fit:,} wait for their turn" if fit < len(jobs) else ""
    lines = [f"{len(cells)} cells × {len(seeds)} seeds = {len(jobs)} lanes"]
    for cell in cells:
        config = cell.config
        lines.append(
            f"  {cell.env:10} {cell.disturbance:24} {config.algorithm:20} "
            f"l={config.history_length:<3} {config.total_steps:,} steps"
        )
    lines += [
        f"programs to compile: {cost.programs}",
        f"memory of the largest lane: {cost.state_bytes / 2**20:,.1f} MiB kept (parameters, "
        f"optimisers, replay, carries), {cost.working_bytes / 2**20:,.1f} MiB more while it "
        "advances (activations, gradients)",
        f"lanes that fit in {_memory() / 2**30:,.1f} GiB"
        f"{' of a device' if strategy == 'vmap' else ''}: {min(fit, len(jobs)):,}{waits}",
        f"time: about {_duration(cost.seconds)} on {count} "
        f"{'cores' if workers()[0].platform == 'cpu' else 'devices'}, "
        "by a count of operations, without compiling",
    ]
    return "\n".join(lines)


def _duration(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds > 5400 else f"{seconds / 60:.1f} min"


def _json_number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _grids(options: argparse.Namespace) -> list[Grid]:
    """The preset's grids with the lists that were given in place of theirs."""
    if options.preset is None and options.env is None:
        raise UserError("say what to run: --preset quick, or --env with --algorithms")
    if options.preset is None:
        grids = [Grid(options.env, ("none",), ALGORITHMS)]
    else:
        grids = list(PRESETS[options.preset])
    given = {
        "env": options.env,
        "disturbances": options.disturbances and tuple(options.disturbances),
        "algorithms": options.algorithms and tuple(options.algorithms),
        "history_lengths": options.history_lengths and tuple(options.history_lengths),
    }
    changes = {name: value for name, value in given.items() if value is not None}
    return [dataclasses.replace(grid, **changes) for grid in grids]


def _overrides(options: argparse.Namespace) -> dict[str, Any]:
    names = (f.name for f in dataclasses.fields(Config) if f.name not in _GRID_FIELDS)
    return {n: getattr(options, n) for n in names if getattr(options, n) is not None}


def _out(options: argparse.Namespace) -> Path:
    if not (options.out or options.preset or options.env):
        raise UserError("say where: --out DIR")
    return Path(options.out or Path("runs") / (options.preset or options.env))


def _count(name: str, value: int, most: int = 100_000) -> int:
    if not 1 <= value <= most:
        raise UserError(f"{name} must be from 1 to {most:,}, not {value}")
    return value


def _device(platform: str) -> Any:
    try:
        return jax.local_devices(backend=platform)[0]
    except RuntimeError as error:
        raise UserError(
            f"--device {platform}: there is none here, or JAX was installed without it "
            "(pip install 'rtd3jax[cuda13]' for NVIDIA GPUs)"
        ) from error


def _import(module: str) -> None:
    """Import what registers worlds; found in the working directory too."""
    sys.path.insert(0, os.getcwd())
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise UserError(f"--import {module}: {error}") from error
    finally:
        sys.path.pop(0)


def _memory() -> int:
    """Bytes of the device's own memory, or of the machine's."""
    limit = (workers()[0].memory_stats() or {}).get("bytes_limit")
    return limit or os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}; --help lists what there is")


def _parser() -> argparse.ArgumentParser:
    worlds = "\n".join(f"  {env}: {', '.join(DISTURBANCES[env])}" for env in ENVIRONMENTS)
    parser = _Parser(
        prog="python -m rtd3jax.sweep",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=f"disturbances:\n{worlds}\n  parameters may follow: noise:sigma=1.0\n"
        "  + joins several: ar1-slip+dropout:p=0.2\n\n"
        "example:\n  python -m rtd3jax.sweep --env pendulum --algorithms td3 lstm-td3-1ha1hc \\\n"
        "      --disturbances random-sine noise --history-lengths 1 10 --seeds 5 --out runs/mine",
    )
    study = parser.add_argument_group("the study")
    study.add_argument("--preset", choices=sorted(PRESETS), help="a prepared study")
    study.add_argument(
        "--env", help=f"{', '.join(ENVIRONMENTS)}, a registered id, or any id that gymnax makes"
    )
    study.add_argument(
        "--import",
        dest="imports",
        action="append",
        default=[],
        metavar="MODULE",
        help="a Python module that registers worlds (rtd3jax.register)",
    )
    study.add_argument("--disturbances", nargs="+", metavar="ID", help="what is hidden [none]")
    study.add_argument("--algorithms", nargs="+", metavar="ID", help=f"{', '.join(ALGORITHMS)}")
    study.add_argument(
        "--history-lengths", nargs="+", type=int, metavar="L", help="past steps in a window [10]"
    )
    study.add_argument("--seeds", type=int, default=5, help="lanes of a cell, seeds 0, 1, ... [5]")
    study.add_argument(
        "--final-episodes", type=int, default=20, help="episodes of the final evaluation [20]"
    )
    work = parser.add_argument_group("the work")
    work.add_argument("--out", metavar="DIR", help="run directory [runs/PRESET or runs/ENV]")
    work.add_argument("--status", action="store_true", help="what is done in --out, lane by lane")
    work.add_argument(
        "--fresh", action="store_true", help="start over; what was there is kept as DIR.old-N"
    )
    work.add_argument("--shard", metavar="I/N", help="this process takes the I-th of N shares")
    work.add_argument(
        "--checkpoint-every",
        default="auto",
        metavar="T",
        help="300s, 5m, 1h or 2000steps [five minutes, or longer where it would cost above 2%%]",
    )
    work.add_argument("--dry-run", action="store_true", help="print the plan and its cost")
    work.add_argument("--quiet", action="store_true", help="no progress bar")
    work.add_argument("--device", choices=("cpu", "gpu", "tpu"), help="where to run [the best]")
    work.add_argument(
        "--strategy", choices=("map", "vmap"), help="lanes one by one or side by side"
    )
    config = parser.add_argument_group("the configuration of every cell")
    for field in dataclasses.fields(Config):
        if field.name not in _GRID_FIELDS:
            default = "" if field.default is None else f" [{field.default}]"
            kind = {"str": str, "float": float}.get(str(getattr(field.type, "__name__", "")), int)
            config.add_argument(
                "--" + field.name.replace("_", "-"),
                type=kind,
                metavar="NAME" if kind is str else "N",
                help=field.metadata["help"].replace("%", "%%") + default,
            )
    return parser


if __name__ == "__main__":
    sys.exit(main())
