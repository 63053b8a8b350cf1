"""``python -m rtd3jax.sweep``: train every cell of a study, and write down what came out.

A cell is an algorithm under a disturbance with a history length; its seeds are trained side by
side. The same command again trains what is missing.
"""

import argparse
import dataclasses
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rtd3jax.config import ALGORITHMS, Config
from rtd3jax.envs.registry import DISTURBANCES, ENVIRONMENTS
from rtd3jax.errors import UserError
from rtd3jax.evaluate import evaluate
from rtd3jax.policy import constant_policy, random_policy
from rtd3jax.study.plan import PRESETS, Cell, Grid, cell_jobs, estimate, lane_bytes, make_cells
from rtd3jax.study.rundir import Reference, RunDirectory
from rtd3jax.training.lanes import Group, Job, advance_groups, make_groups, workers
from rtd3jax.training.progress import Progress
from rtd3jax.training.run import check_strategy, curves_of, evaluation_steps, failure_of

REFERENCE_EPISODES = 1_000
_GRID_FIELDS = ("algorithm", "history_length")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit status: 0 done, 1 lanes were lost, 2 bad input, 130 interrupted."""
    options = _parser().parse_args(arguments)
    try:
        if options.device:
            jax.config.update("jax_default_device", _device(options.device))
        return _run(options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _run(options: argparse.Namespace) -> int:
    cells = make_cells(_grids(options), _overrides(options))
    seeds = list(range(_positive("seeds", options.seeds)))
    episodes = _positive("final_episodes", options.final_episodes)
    strategy = check_strategy(options.strategy)
    jobs = cell_jobs(cells, seeds, strategy)
    if options.dry_run:
        print(_plan_text(cells, seeds, jobs))
        return 0
    _check_memory(jobs)
    directory = RunDirectory(_out(options), cells, seeds, episodes)
    waiting = [job for job in jobs if not directory.is_done(*job.owner)]
    if len(waiting) < len(jobs):
        print(f"{len(jobs) - len(waiting)} of {len(jobs)} lanes are there already")
    lost = interrupted = False
    groups = make_groups(waiting, strategy, len(workers()))
    recorder = _Recorder(directory, episodes)
    references = [r for cell in _worlds(cells) for r in _references(cell)]
    try:
        with Progress(groups, _label, enabled=not options.quiet) as bar:

            def on_chunk(group: Group) -> None:
                bar.update(group)
                recorder.update(group)

            advance_groups(groups, on_chunk)
    except KeyboardInterrupt:
        interrupted = True
    directory.derive(references)
    for line in recorder.complaints:
        print(line, file=sys.stderr)
        lost = True
    print((directory.path / "summary.md").read_text())
    print(f"results: {directory.path}")
    if interrupted:
        print("interrupted: the same command goes on with the lanes that are missing")
        return 130
    return 1 if lost else 0


class _Recorder:
    """Writes lanes down as they end, and the log as they go."""

    def __init__(self, directory: RunDirectory, episodes: int):
        self._directory = directory
        self._episodes = episodes
        self._logged: dict[int, int] = {}
        self._began = time.perf_counter()
        self.complaints: list[str] = []

    def update(self, group: Group) -> None:
        if group.error is not None:
            cell, seed = group.jobs[0].owner
            reason = str(group.error).splitlines()[0] if str(group.error) else repr(group.error)
            self.complaints.append(f"{_label(group.jobs[0])} seed {seed} failed: {reason}")
            return
        self._log(group)
        # An event may be read late, after the one that already kept the group.
        if group.finished and group.state is not None:
            for job, state in group.lanes():
                self._keep(job, state)
            group.state = None  # its replay is no longer needed

    def _log(self, group: Group) -> None:
        assert group.returns is not None
        with (self._directory.path / "log.jsonl").open("a") as log:
            for index, job in enumerate(group.jobs):
                cell, seed = job.owner
                curve, steps = group.returns[index], evaluation_steps(cell.config)
                reached = int(np.sum(steps <= group.step))
                for k in range(self._logged.get(id(job), 0), reached):
                    row = {
                        **cell.key,
                        "seed": seed,
                        "step": int(steps[k]),
                        "return": _json_number(curve[k]),
                        "seconds": round(time.perf_counter() - self._began, 3),
                    }
                    log.write(json.dumps(row) + "\n")
                self._logged[id(job)] = reached

    def _keep(self, job: Job, state: Any) -> None:
        cell, seed = job.owner
        failure = failure_of(seed, state)
        returns, true_returns = curves_of(cell.config, state, failure)
        final = np.full((2, self._episodes), np.nan, np.float32)
        if failure is None:
            policy = job.program.policy(job.lane, state.learner.actor)
            final = np.stack(_both_returns(policy, cell.make_env(), self._episodes, seed))
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


def _plan_text(cells: Sequence[Cell], seeds: Sequence[int], jobs: Sequence[Job]) -> str:
    count = len(workers())
    cost = estimate(jobs, count)
    lines = [f"{len(cells)} cells × {len(seeds)} seeds = {len(jobs)} lanes"]
    for cell in cells:
        config = cell.config
        lines.append(
            f"  {cell.env:10} {cell.disturbance:24} {config.algorithm:20} "
            f"l={config.history_length:<3} {config.total_steps:,} steps"
        )
    lines += [
        f"programs to compile: {cost.programs}",
        f"memory: {cost.lane_bytes / 2**20:,.0f} MiB for the state of the largest lane; "
        f"{len(seeds)} lanes of a cell are held at once",
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
    return Path(options.out or Path("runs") / (options.preset or options.env))


def _positive(name: str, value: int) -> int:
    if value < 1:
        raise UserError(f"{name} must be at least 1, not {value}")
    return value


def _device(platform: str) -> Any:
    try:
        return jax.local_devices(backend=platform)[0]
    except RuntimeError as error:
        raise UserError(
            f"--device {platform}: there is none here, or JAX was installed without it "
            "(pip install 'rtd3jax[cuda13]' for NVIDIA GPUs)"
        ) from error


def _check_memory(jobs: Sequence[Job]) -> None:
    """Refuse lanes of which not even one fits."""
    needed, there = max(lane_bytes(jobs).values()), _memory()
    if needed > there:
        raise UserError(
            f"one lane needs {needed / 2**30:,.1f} GiB and the machine has {there / 2**30:,.1f}; "
            "lower replay_capacity or hidden_size"
        )


def _memory() -> int:
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _parser() -> argparse.ArgumentParser:
    worlds = "\n".join(f"  {env}: {', '.join(DISTURBANCES[env])}" for env in ENVIRONMENTS)
    parser = argparse.ArgumentParser(
        prog="python -m rtd3jax.sweep",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=f"disturbances:\n{worlds}\n  parameters may follow: noise:sigma=1.0\n\n"
        "example:\n  python -m rtd3jax.sweep --env pendulum --algorithms td3 lstm-td3-1ha1hc \\\n"
        "      --disturbances random-sine noise --history-lengths 1 10 --seeds 5 --out runs/mine",
    )
    study = parser.add_argument_group("the study")
    study.add_argument("--preset", choices=sorted(PRESETS), help="a prepared study")
    study.add_argument("--env", help=f"{', '.join(ENVIRONMENTS)}, or any id that gymnax makes")
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
            config.add_argument(
                "--" + field.name.replace("_", "-"),
                type=int if "int" in str(field.type) else float,
                metavar="N",
                help=field.metadata["help"].replace("%", "%%") + default,
            )
    return parser


if __name__ == "__main__":
    sys.exit(main())
