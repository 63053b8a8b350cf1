"""The result of a training: learning curves, metrics, policies, and lanes that were lost."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from rtd3jax.config import Config
from rtd3jax.envs.compat.simulator import fault_of
from rtd3jax.envs.compat.simulator_state import simulator_state
from rtd3jax.errors import UserError
from rtd3jax.policies.trained import Policy
from rtd3jax.training.jobs import Job
from rtd3jax.training.lane import (
    ACTION_NOT_FINITE,
    ENVIRONMENT_NOT_FINITE,
    HEALTHY,
    LOSS_NOT_FINITE,
    LaneState,
)

_REASONS = {
    ENVIRONMENT_NOT_FINITE: "the environment returned an observation or reward that is not finite; "
    "check its reset and step functions",
    LOSS_NOT_FINITE: "the critics' loss is not finite; lower actor_learning_rate and "
    "critic_learning_rate",
    ACTION_NOT_FINITE: "the actor's action is not finite; lower actor_learning_rate",
}


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
        policies.append(None if failure else _own_policy(job, state))
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


def _own_policy(job: Job, state: LaneState) -> Policy:
    """The policy of a lane, with a window of its own length, as if it was saved and loaded.

    A program of lanes with several history lengths has the longest window.
    """
    policy = job.program.policy(job.lane, state)
    return dataclasses.replace(policy, window_tokens=int(policy.history_length))


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
