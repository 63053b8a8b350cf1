"""`train`: seeds of one configuration on one environment; the library's main call."""

import dataclasses
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import jax
import numpy as np

from rtd3jax.config import Config
from rtd3jax.envs.compat.from_gymnasium import (
    is_simulated,
    simulated_identity,
    simulator_state,
)
from rtd3jax.envs.compat.simulator import fault_of
from rtd3jax.envs.entry import parameters_of
from rtd3jax.envs.interface import describe
from rtd3jax.errors import UserError
from rtd3jax.policies.trained import Policy
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.system.files import user_path
from rtd3jax.system.switches import check_compiling
from rtd3jax.training.checkpoint import Checkpoints, named_numbers
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
    make_lane,
    make_program,
)
from rtd3jax.training.progress import Progress
from rtd3jax.training.start import Start, starts_of_path

_REASONS = {
    ENVIRONMENT_NOT_FINITE: "the environment gave an observation or reward that is not finite; "
    "check its step function",
    LOSS_NOT_FINITE: "the critics' loss is not finite; lower actor_learning_rate and "
    "critic_learning_rate",
}
_NO_CHECKPOINTS = "no checkpoints are kept: if this process ends, all is lost (checkpoint_dir=...)"


@dataclasses.dataclass(frozen=True)
class Failure:
    """A lane that was lost: at which step, and why. ``step`` is -1 where it is not known."""

    seed: int
    step: int
    reason: str


@dataclasses.dataclass(frozen=True)
class Run:
    """What `train` gives.

    Attributes:
        config: what was trained.
        seeds: of the lanes, in the order asked for.
        eval_steps: int64 [K], environment steps at each evaluation.
        returns: float32 [seeds, K], mean return of an evaluation's episodes; NaN after a lane
            was lost.
        true_returns: the same of the undisturbed state's reward.
        failures: the lanes that were lost.
        metrics: of learning, float32 [seeds, K] by name, averaged over the steps since the last
            evaluation; NaN where nothing was measured. docs/run_a_study.md says what each is.
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
        """The trained policy of ``seed``."""
        if seed not in self.seeds:
            raise UserError(f"seed {seed} was not trained; the seeds are {list(self.seeds)}")
        policy = self._policies[self.seeds.index(seed)]
        if policy is None:
            raise UserError(f"seed {seed} was lost in training: {self._failure(seed).reason}")
        return policy

    def _failure(self, seed: int) -> Failure:
        return next(failure for failure in self.failures if failure.seed == seed)


StartLike = Policy | Run | str | Path | None
"""What `train` may go on from; None for new weights."""


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
    """Train one lane per seed, of one configuration or of each of several.

    Args:
        env: a gymnax >= 1.0 environment with a bounded Box of actions.
        config: of the agent; or several, of which those that differ in traced fields alone (such
            as learning rates and the discount) share one compiled program.
        seeds: distinct integers of at least 0; a seed's result does not depend on the others.
        params: the environment's parameters; its own by default.
        progress: whether to show a bar.
        checkpoint_dir: where lanes keep checkpoints. The same call again goes on from them, to the
            bit; seeds that were finished are not trained again, and go on where ``total_steps`` is
            larger now. Of several configurations each has a directory there, ``config-0``,
            ``config-1``, ... Without it, a process that is killed loses everything.
        checkpoint_seconds: between two checkpoints of a lane; five minutes by default, or longer
            where they would cost more than 2%.
        start: what training goes on from: a `Policy`, a `Run` of the same seeds, the file of a
            saved policy, or the ``checkpoint_dir`` of another training, which has critics and
            optimisers too. See also ``freeze`` and ``actor_starts`` of `Config`.
        strategy: ``map`` (lanes one by one, each on one core) or ``vmap`` (side by side); by
            default what suits the backend.

    Returns:
        The run; of several configurations, a run for each, in their order.

    Raises:
        UserError: for an unfit environment or impossible arguments, before anything is compiled.
    """
    single = isinstance(config, Config)
    configs = [config] if isinstance(config, Config) else list(config)
    if not configs or not all(isinstance(one, Config) for one in configs):
        raise UserError(f"config must be an rtd.Config, or several of them, not {config!r}")
    seeds = check_seeds(seeds)
    starts = [_starts(start if start is not None else one.start or None, seeds) for one in configs]
    configs = [
        dataclasses.replace(one, start=own[seeds[0]].where) if own else one
        for one, own in zip(configs, starts, strict=True)
    ]
    jobs = [
        job
        for index, (one, own) in enumerate(zip(configs, starts, strict=True))
        for job in make_jobs(env, one, seeds, params=params, cell=index, starts=own)
    ]
    checkpoints = None
    if checkpoint_dir is not None:
        directory = user_path(checkpoint_dir)
        parts = [directory] if single else [directory / f"config-{k}" for k in range(len(configs))]
        checkpoints = _checkpoints(parts, configs, env, checkpoint_seconds)
    strategy, remark = check_strategy(strategy), "" if checkpoints is not None else _NO_CHECKPOINTS
    check_starts(jobs, checkpoints)
    groups = make_groups(jobs, strategy, len(workers()), checkpoints=checkpoints)

    def label(job: Job) -> str:
        own = configs[job.cell]
        number = "" if single else f" {job.cell}"
        return f"{own.algorithm} l={own.history_length}{number}"

    with Progress(groups, label, enabled=progress, remark=remark) as bar:
        advance_groups(groups, bar.update, checkpoints)
    if checkpoints is not None:
        for group in groups:
            if group.error is None:
                checkpoints.save(group.lanes(), group, group.step)
    lanes = _ended(groups)
    runs = [
        collect(one, seeds, {seed: lanes[index, seed] for seed in seeds})
        for index, one in enumerate(configs)
    ]
    return runs[0] if single else runs


def _checkpoints(
    directories: Sequence[Path],
    configs: Sequence[Config],
    env: EnvironmentLike,
    seconds: float | None,
) -> Checkpoints:
    environment = {"env": str(getattr(env, "name", type(env).__name__)), "params": None}
    if is_simulated(env):  # what is seen of it, and with what it was made
        environment["env"] = simulated_identity(env)

    def identity(job: Job) -> dict[str, Any]:
        index, seed = job.key
        params = [named_numbers(leaf) for leaf in jax.tree.leaves(job.lane.env_params)]
        own = {"start": job.start.where} if job.start is not None else {}
        return {**configs[index].to_dict(), **own, **environment, "params": params, "seed": seed}

    return Checkpoints(lambda job: directories[job.cell] / f"seed-{job.seed}", identity, seconds)


def _ended(groups: Iterable[Group]) -> dict[tuple[Any, int], tuple[Job, LaneState]]:
    """The lanes of groups that have ended, by key; an error of a whole group is raised."""
    found: dict[tuple[Any, int], tuple[Job, LaneState]] = {}
    for group in groups:
        if group.error is not None:
            raise group.error
        found.update({job.key: (job, state) for job, state in group.lanes()})
    return found


def _horizon(params: Any) -> int | None:
    """The most steps of an episode, where the environment's parameters say it as gymnax's do."""
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
    """A job per seed, which is called ``(cell, seed)``; checks the environment.

    With ``window``, jobs of shorter history lengths share the program of that length.
    """
    check_compiling()
    params = parameters_of(env, params)
    warn_if_untrained(config)
    check_segments(config, _horizon(params))
    interface = describe(env, params)
    program = make_program(env, config, interface.observation_size, interface.action_shape, window)
    starts = starts or {}
    return [
        Job(program, make_lane(config, seed, params), cell, seed, starts.get(seed))
        for seed in seeds
    ]


def check_starts(jobs: Iterable[Job], checkpoints: Checkpoints | None) -> None:
    """Raise UserError where a lane that is new cannot begin from what it is to go on from."""
    for job in jobs:
        if job.start is not None and not (checkpoints and checkpoints.newest(job)):
            job.start.check(job.program, job.lane)


def _starts(start: StartLike, seeds: tuple[int, ...]) -> dict[int, Start]:
    """What each seed goes on from; empty for new weights."""
    if start is None:
        return {}
    if isinstance(start, Policy):
        digest = hashlib.sha256(b"".join(a.tobytes() for a in start.parameters().values()))
        name = f"a policy of {start.algorithm} ({digest.hexdigest()[:12]})"
        return dict.fromkeys(seeds, Start(name, start))
    if isinstance(start, Run):
        return {seed: _starts(start.policy(seed), (seed,))[seed] for seed in seeds}
    if isinstance(start, str | Path):
        return starts_of_path(start, seeds)
    raise UserError(
        "start must be a policy, a run of rtd.train, the path of a saved policy or a directory of "
        f"checkpoints, not {start!r}"
    )


def collect(
    config: Config, seeds: Sequence[int], lanes: Mapping[int, tuple[Job, LaneState]]
) -> Run:
    """The run of these seeds, from their lanes that have ended."""
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
    """What became of a lane, if it was lost."""
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
    """Distinct integers in 0..2**32-1, at least one."""
    seeds = tuple(seeds)
    for seed in seeds:
        if isinstance(seed, bool) or seed != int(seed) or not 0 <= seed < 2**32:
            raise UserError(f"seeds must be integers from 0 to 2**32 - 1, not {seed!r}")
    if not seeds or len(set(seeds)) < len(seeds):
        raise UserError(f"seeds must be distinct and at least one, not {list(seeds)}")
    return tuple(int(seed) for seed in seeds)


def check_strategy(strategy: str | None) -> str:
    """The strategy, or the backend's own."""
    if strategy not in (None, "map", "vmap"):
        raise UserError(f"strategy must be 'map' or 'vmap', not {strategy!r}")
    return strategy or default_strategy()


def evaluation_steps(config: Config) -> np.ndarray:
    """Environment steps done at each evaluation: int64 [K]; the last is the end."""
    count = -(-config.total_steps // config.eval_every)
    return np.minimum(np.arange(1, count + 1) * config.eval_every, config.total_steps)


def curves_of(
    config: Config, state: LaneState, failure: Failure | None
) -> tuple[np.ndarray, np.ndarray]:
    """A lane's returns and true returns [K]; nothing after its loss counts."""
    lost = evaluation_steps(config) > (np.inf if failure is None else failure.step)
    returns, true_returns = (
        np.where(lost, np.float32(np.nan), np.asarray(curve))
        for curve in (state.returns, state.true_returns)
    )
    return returns, true_returns


def metric_curves(
    config: Config, state: LaneState, failure: Failure | None
) -> dict[str, np.ndarray]:
    """A lane's metrics of learning [K] by name; nothing after its loss counts."""
    lost = evaluation_steps(config) > (np.inf if failure is None else failure.step)
    curves = np.where(lost[:, None], np.float32(np.nan), np.asarray(state.metrics.curves))
    return dict(zip(state.metrics.names, curves.T, strict=True))
