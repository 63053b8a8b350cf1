"""`train`: trains seeds of one configuration, or of several, on one environment."""

import dataclasses
import functools
import hashlib
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from rtd3jax.config import Config
from rtd3jax.envs.compat.simulator import fault_of
from rtd3jax.envs.compat.simulator_state import simulator_state
from rtd3jax.envs.entry import parameters_of
from rtd3jax.envs.interface import describe
from rtd3jax.errors import UserError
from rtd3jax.policies.trained import Policy
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.system.files import user_path
from rtd3jax.system.numbers import is_whole
from rtd3jax.system.switches import check_compiling
from rtd3jax.training.checkpoint import Checkpoints, lane_directory
from rtd3jax.training.feasibility import check_segments, warn_if_untrained
from rtd3jax.training.lanes import (
    Group,
    Job,
    advance_groups,
    default_strategy,
    make_groups,
    workers,
)
from rtd3jax.training.loop import (
    ENVIRONMENT_NOT_FINITE,
    HEALTHY,
    LOSS_NOT_FINITE,
    LaneState,
    as_arrays,
    make_lane,
    make_program,
)
from rtd3jax.training.plant import plant_of
from rtd3jax.training.progress import Progress
from rtd3jax.training.start import IN_MEMORY, Start, starts_if_needed, starts_of_path

_REASONS = {
    ENVIRONMENT_NOT_FINITE: "the environment returned an observation or reward that is not finite; "
    "check its reset and step functions",
    LOSS_NOT_FINITE: "the critics' loss is not finite; lower actor_learning_rate and "
    "critic_learning_rate",
}
_NO_CHECKPOINTS = (
    "no checkpoints are written: if this process ends, the training is lost (checkpoint_dir=...)"
)


@dataclasses.dataclass(frozen=True)
class Failure:
    """A lane that was lost: the step and the reason. ``step`` is -1 if it is not known."""

    seed: int
    step: int
    reason: str


@dataclasses.dataclass(frozen=True)
class Run:
    """The result of `train`.

    Attributes:
        config: the configuration.
        seeds: the seeds of the lanes, in the order of the argument.
        eval_steps: int64 [K], environment steps at each evaluation.
        returns: float32 [seeds, K], mean return of the episodes of an evaluation; NaN after a lane
            was lost.
        true_returns: float32 [seeds, K], mean return of the undisturbed state's reward.
        failures: the lanes that were lost.
        metrics: metrics of learning by name, float32 [seeds, K], averaged over the steps since the
            last evaluation; NaN without measurements. docs/run_a_study.md explains each.
    """

    config: Config
    seeds: tuple[int, ...]
    eval_steps: np.ndarray
    returns: np.ndarray
    true_returns: np.ndarray
    failures: tuple[Failure, ...]
    metrics: dict[str, np.ndarray]
    _policies: tuple[Policy | None, ...] = dataclasses.field(repr=False)

    def policy(self, seed: int) -> Policy:
        """The trained policy of ``seed``.

        Raises:
            UserError: when ``seed`` was not trained, or its lane was lost.
        """
        if seed not in self.seeds:
            raise UserError(f"seed {seed} was not trained; the seeds are {list(self.seeds)}")
        policy = self._policies[self.seeds.index(seed)]
        if policy is None:
            raise UserError(f"seed {seed} was lost in training: {self._failure(seed).reason}")
        return policy

    def _failure(self, seed: int) -> Failure:
        return next(failure for failure in self.failures if failure.seed == seed)


StartLike = Policy | Run | str | Path | None
"""Networks from which `train` can start; None for new weights."""


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
        _starts(source, seeds, directories[index] if directories else None)
        for index, source in enumerate(sources)
    ]
    configs = [
        dataclasses.replace(one, start=_start_field(source, own[seeds[0]])) if own else one
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
    check_starts(jobs, checkpoints)
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


def _horizon(params: Any) -> int | None:
    """The time limit in the environment's parameters, as in gymnax's; None without it."""
    own = getattr(params, "env", params)
    steps = getattr(own, "max_steps_in_episode", None)
    return int(steps) if isinstance(steps, int) else None


def make_jobs(
    env: EnvironmentLike,
    config: Config,
    seeds: Sequence[int],
    *,
    params: object = None,
    cell: object = None,
    window: int | None = None,
    starts: Mapping[int, Start] | None = None,
) -> list[Job]:
    """Check the environment, and make a job per seed with key ``(cell, seed)``.

    With ``window``, jobs of shorter history lengths share the program of length ``window``.

    Raises:
        UserError: for an unsuitable environment or configuration.
    """
    check_compiling()
    params = parameters_of(env, params)
    warn_if_untrained(config)
    check_segments(config, _horizon(params))
    interface = describe(env, params)
    program = make_program(
        env,
        config,
        interface.observation_size,
        interface.action_shape,
        window,
        interface.true_observation_size,
    )
    _ = program.agent  # raises UserError, before anything is compiled or written
    starts = starts or {}
    params = as_arrays(params)  # once, so that the lanes share a recording
    return [
        Job(program, make_lane(config, seed, params), cell, seed, starts.get(seed))
        for seed in seeds
    ]


def check_starts(jobs: Iterable[Job], checkpoints: Checkpoints | None) -> None:
    """Raise UserError if a new lane cannot start from the given networks."""
    for job in jobs:
        if job.start is not None and not (checkpoints and checkpoints.steps(job)):
            job.start.check(job.program, job.lane)


def _start_field(source: StartLike, start: Start) -> str:
    """The field ``start`` of a configuration: a path that a later training can read, or a name."""
    return str(user_path(source)) if isinstance(source, str | Path) else start.where


def _starts(
    start: StartLike, seeds: tuple[int, ...], directory: Path | None = None
) -> dict[int, Start]:
    """The networks from which each seed starts; empty for new weights.

    ``directory`` has the checkpoints of the seeds, None without checkpoints.
    """
    if start is None:
        return {}
    if isinstance(start, Policy):
        digest = hashlib.sha256(b"".join(a.tobytes() for a in start.parameters().values()))
        name = f"{IN_MEMORY}{start.algorithm} ({digest.hexdigest()[:12]})"
        return dict.fromkeys(seeds, Start(name, start))
    if isinstance(start, Run):
        return {seed: _starts(start.policy(seed), (seed,))[seed] for seed in seeds}
    if isinstance(start, str | Path):
        if directory is None:
            return starts_of_path(start, seeds)
        return starts_if_needed(start, {seed: lane_directory(directory, seed) for seed in seeds})
    raise UserError(
        "start must be a policy, a run of rtd.train, the path of a saved policy, or a directory "
        f"of checkpoints, not {start!r}"
    )


def collect(
    config: Config, seeds: Sequence[int], lanes: Mapping[int, tuple[Job, LaneState]]
) -> Run:
    """The run of these seeds, from their ended lanes."""
    steps = evaluation_steps(config)
    failures, policies, returns, true_returns, metrics = [], [], [], [], []
    for seed in seeds:
        job, state = lanes[seed]
        failure = failure_of(seed, state)
        curve, true_curve = curves_of(config, state, failure)
        returns.append(curve)
        true_returns.append(true_curve)
        metrics.append(metric_curves(config, state, failure))
        policies.append(None if failure else job.program.policy(job.lane, state))
        failures += [failure] if failure else []
    return Run(
        config,
        tuple(seeds),
        steps,
        np.stack(returns),
        np.stack(true_returns),
        tuple(failures),
        {name: np.stack([lane[name] for lane in metrics]) for name in metrics[0]},
        tuple(policies),
    )


def failure_of(seed: int, state: LaneState) -> Failure | None:
    """The failure of a lane; None if it was not lost."""
    code = int(state.failure)
    if code == HEALTHY:
        return None
    reason = _REASONS[code]
    simulator = simulator_state(state.env_state)
    if code == ENVIRONMENT_NOT_FINITE and simulator is not None:
        handles = np.asarray(simulator.handle).reshape(-1)
        reason = next(filter(None, map(fault_of, handles.tolist())), reason)
    return Failure(seed, int(state.failed_at), reason)


def check_seeds(seeds: Iterable[int]) -> tuple[int, ...]:
    """The seeds as integers; UserError for no seeds, equal seeds, or seeds outside [0, 2**32)."""
    listed = as_list(seeds)
    if listed is None:
        raise UserError(f"seeds must be a sequence of integers such as range(5), not {seeds!r}")
    seeds = tuple(listed)
    for seed in seeds:
        if not is_whole(seed) or not 0 <= seed < 2**32:
            raise UserError(f"seeds must be integers from 0 to 2**32 - 1, not {seed!r}")
    if not seeds or len(set(seeds)) < len(seeds):
        raise UserError(f"seeds must be distinct and at least one, not {list(seeds)}")
    return tuple(int(seed) for seed in seeds)


def as_list(values: object) -> list[Any] | None:
    """The values of something that can be iterated over; None for anything else."""
    return list(values) if isinstance(values, Iterable) else None


def check_checkpoints(directory: object, seconds: object) -> None:
    """Raise UserError unless these are a path, and a time in seconds; both may be None."""
    if not (directory is None or isinstance(directory, str | os.PathLike)):
        raise UserError(f"checkpoint_dir must be a path, not {directory!r}")
    if seconds is None:
        return
    number = float(seconds) if isinstance(seconds, float | int | np.number) else -1.0
    if isinstance(seconds, bool) or not number >= 0:  # also NaN
        raise UserError(f"checkpoint_seconds must be a number of at least 0, not {seconds!r}")


def check_strategy(strategy: str | None) -> str:
    """The strategy; by default the one for the backend."""
    if strategy not in (None, "map", "vmap"):
        raise UserError(f"strategy must be 'map' or 'vmap', not {strategy!r}")
    return strategy or default_strategy()


def evaluation_steps(config: Config) -> np.ndarray:
    """Number of environment steps at each evaluation: int64 [K]; the last is the end."""
    count = -(-config.total_steps // config.eval_every)
    return np.minimum(np.arange(1, count + 1) * config.eval_every, config.total_steps)


def curves_of(
    config: Config, state: LaneState, failure: Failure | None
) -> tuple[np.ndarray, np.ndarray]:
    """A lane's returns and true returns [K]; NaN after the lane was lost."""
    lost = evaluation_steps(config) > (np.inf if failure is None else failure.step)
    returns, true_returns = (
        np.where(lost, np.float32(np.nan), np.asarray(curve))
        for curve in (state.returns, state.true_returns)
    )
    return returns, true_returns


def metric_curves(
    config: Config, state: LaneState, failure: Failure | None
) -> dict[str, np.ndarray]:
    """A lane's metrics of learning [K] by name; NaN after the lane was lost."""
    lost = evaluation_steps(config) > (np.inf if failure is None else failure.step)
    curves = np.where(lost[:, None], np.float32(np.nan), np.asarray(state.metrics.curves))
    return dict(zip(state.metrics.names, curves.T, strict=True))
