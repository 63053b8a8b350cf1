"""`train`: trains seeds of one configuration, or of several, on one environment."""

import dataclasses
import functools
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, overload

from rtd3jax.config import Config
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.system.files import user_path
from rtd3jax.training.arguments import as_list, check_checkpoints, check_seeds, check_strategy
from rtd3jax.training.checkpoint import Checkpoints
from rtd3jax.training.checkpoint_files import lane_directory
from rtd3jax.training.devices import workers
from rtd3jax.training.grouping import make_groups
from rtd3jax.training.groups import Group
from rtd3jax.training.jobs import Job, make_jobs
from rtd3jax.training.lane import LaneState
from rtd3jax.training.lanes import advance_groups
from rtd3jax.training.plant import plant_of
from rtd3jax.training.progress import Progress
from rtd3jax.training.result import Run, collect
from rtd3jax.training.starts import StartLike, start_field, starts_from

_NO_CHECKPOINTS = (
    "no checkpoints are written: if this process ends, the training is lost (checkpoint_dir=...)"
)


@overload
def train(
    env: EnvironmentLike,
    config: Config,
    seeds: Iterable[int] = range(5),
    *,
    params: object = None,
    progress: bool = True,
    strategy: str | None = None,
    checkpoint_dir: str | Path | None = None,
    checkpoint_seconds: float | None = None,
    start: StartLike = None,
) -> Run: ...


@overload
def train(
    env: EnvironmentLike,
    config: Sequence[Config],
    seeds: Iterable[int] = range(5),
    *,
    params: object = None,
    progress: bool = True,
    strategy: str | None = None,
    checkpoint_dir: str | Path | None = None,
    checkpoint_seconds: float | None = None,
    start: StartLike = None,
) -> list[Run]: ...


def train(
    env: EnvironmentLike,
    config: Config | Sequence[Config],
    seeds: Iterable[int] = range(5),
    *,
    params: object = None,
    progress: bool = True,
    strategy: str | None = None,
    checkpoint_dir: str | Path | None = None,
    checkpoint_seconds: float | None = None,
    start: StartLike = None,
) -> Run | list[Run]:
    """Train one lane per seed, for one configuration or for each of several.

    Args:
        env: a gymnax >= 1.0 environment with a bounded Box of actions.
        config: the configuration of the agent, or several. Configurations that only differ in
            traced fields (such as learning rates and the discount factor) share a compiled program.
        seeds: distinct integers of at least 0; the result of a seed does not depend on the others.
        params: the environment's parameters; its default parameters by default.
        progress: whether to show a progress bar.
        checkpoint_dir: directory for checkpoints. If you repeat the call, training continues from
            them, with bit-identical results on the same number of cores; seeds that have ended are
            not trained again, unless ``total_steps`` is larger now. With several configurations,
            each has a subdirectory, ``config-0``, ``config-1``, ... Without checkpoints, the
            training is lost if the process is killed.
        checkpoint_seconds: time between two checkpoints of a lane; by default five minutes, or
            longer if checkpoints would take more than 2% of the time.
        start: networks from which training starts: a `Policy`, a `Run` with the same seeds, the
            file of a saved policy, or the ``checkpoint_dir`` of another training, which also holds
            critics and optimisers. A lane that continues from a checkpoint does not need the file
            or directory any more. See also ``freeze`` and ``actor_starts`` of `Config`.
        strategy: ``map`` (lanes one after the other, each on one core) or ``vmap`` (one batched
            program); by default ``map`` on a CPU and ``vmap`` on an accelerator.

    Returns:
        The run; for several configurations, a list of runs in their order.

    Raises:
        UserError: for an unsuitable environment, impossible arguments or checkpoints of another
            training, before compilation.
        Exception: an error in a lane; at once, or with ``checkpoint_dir`` when the other lanes have
            ended, whose checkpoints are then complete, unless a warning said otherwise.
    """
    single = isinstance(config, Config)
    configs = [config] if isinstance(config, Config) else as_list(config)
    if not configs or not all(isinstance(one, Config) for one in configs):
        raise UserError(f"config must be an rtd.Config, or several of them, not {config!r}")
    seeds = check_seeds(seeds)
    check_checkpoints(checkpoint_dir, checkpoint_seconds)
    directories = _directories(checkpoint_dir, None if single else len(configs))
    sources = [start if start is not None else one.start or None for one in configs]
    starts = [
        starts_from(source, seeds, directories[index] if directories else None)
        for index, source in enumerate(sources)
    ]
    configs = [
        dataclasses.replace(one, start=start_field(source, own[seeds[0]])) if own else one
        for one, source, own in zip(configs, sources, starts, strict=True)
    ]
    jobs = [
        job
        for index, (one, own) in enumerate(zip(configs, starts, strict=True))
        for job in make_jobs(env, one, seeds, params=params, cell=index, starts=own)
    ]
    checkpoints = None
    if directories:
        checkpoints = _checkpoints(directories, configs, env, checkpoint_seconds)
    strategy, remark = check_strategy(strategy), "" if checkpoints is not None else _NO_CHECKPOINTS
    _check_starts(jobs, checkpoints)
    if checkpoints is not None:
        for job in jobs:
            checkpoints.check(job)
        checkpoints.prepare(
            job for job in jobs if job.program.config.total_steps not in checkpoints.steps(job)
        )
    groups = make_groups(jobs, strategy, len(workers()), checkpoints=checkpoints)

    def label(job: Job) -> str:
        own = configs[job.cell]
        number = "" if single else f" {job.cell}"
        return f"{own.words}{number}"

    lanes: dict[tuple[Any, int], tuple[Job, LaneState]] = {}
    with Progress(groups, label, enabled=progress, remark=remark) as bar:

        def on_chunk(group: Group) -> None:
            bar.update(group)
            if group.error is not None and checkpoints is None:
                raise group.error  # it ends the training: nothing would keep the other lanes
            # An event may arrive after the one at which the group was collected.
            if not group.finished or group.error is not None or group.state is None:
                return
            # Other lanes may train for hours before this call ends.
            if checkpoints is not None:
                _save_ended(group, checkpoints)
            for job, state in group.lanes():
                lanes[job.key] = job, _without_replay(state)
            group.state = None

        advance_groups(groups, on_chunk, checkpoints)
    for group in groups:
        if group.error is not None:
            raise group.error
    runs = [
        collect(one, seeds, {seed: lanes[index, seed] for seed in seeds})
        for index, one in enumerate(configs)
    ]
    return runs[0] if single else runs


def _check_starts(jobs: Iterable[Job], checkpoints: Checkpoints | None) -> None:
    """Raise UserError if a new lane cannot start from the given networks."""
    for job in jobs:
        if job.start is not None and not (checkpoints and checkpoints.steps(job)):
            job.start.check(job.program, job.lane)


def _save_ended(group: Group, checkpoints: Checkpoints) -> None:
    """Write checkpoints of a group that has ended; a full disk does not end the training."""
    try:
        checkpoints.save_once(group)
    except UserError as error:
        warnings.warn(
            f"{error}; the result is kept in memory only: save the policies when the training ends",
            stacklevel=2,
        )


def _directories(checkpoint_dir: str | Path | None, configs: int | None) -> list[Path]:
    """The directory of checkpoints of each configuration, None for a single one; none without."""
    if checkpoint_dir is None:
        return []
    directory = user_path(checkpoint_dir)
    if configs is None:
        return [directory]
    return [directory / f"config-{index}" for index in range(configs)]


def _checkpoints(
    directories: Sequence[Path],
    configs: Sequence[Config],
    env: EnvironmentLike,
    seconds: float | None,
) -> Checkpoints:
    # A recording is digested once for each lane, not at every checkpoint.
    plant = functools.cache(lambda job: plant_of(env, job.lane.env_params))

    def identity(job: Job) -> dict[str, Any]:
        index, seed = job.key
        own = {"start": job.start.where} if job.start is not None else {}
        return {**configs[index].to_dict(), **own, **plant(job), "seed": seed}

    return Checkpoints(
        lambda job: lane_directory(directories[job.cell], job.seed), identity, seconds
    )


def _without_replay(state: LaneState) -> LaneState:
    """The state of a lane that has ended; its replay takes most of the memory."""
    nothing: Any = None
    return dataclasses.replace(state, replay=nothing)
