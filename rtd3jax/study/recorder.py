"""Writes the files of lanes when they end, and the log during training."""

import math
import time
import warnings
from typing import Any

import numpy as np

from rtd3jax.errors import UserError, short_reason
from rtd3jax.evaluation.returns import both_returns
from rtd3jax.study.interim import InterimResults
from rtd3jax.study.log import LOG, LoggedReturns, append_rows, repair_log
from rtd3jax.study.loggers import Logger
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.training.checkpoint import Checkpoints
from rtd3jax.training.groups import Group
from rtd3jax.training.jobs import Job
from rtd3jax.training.lane import HEALTHY, LaneState
from rtd3jax.training.result import curves_of, evaluation_steps, failure_of, metric_curves


class Recorder:
    """Writes the files of lanes when they end, and the log during training."""

    def __init__(
        self,
        directory: RunDirectory,
        checkpoints: Checkpoints,
        interim: InterimResults | None,
        logger: Logger | None,
        complaints: list[str],
        *,
        keep: bool = False,
        began: float | None = None,
        logged: LoggedReturns | None = None,
    ):
        """Create the recorder.

        Without ``interim``, another process updates the tables and the page. With ``keep``, the
        last checkpoint of a lane is kept when the lane ends. ``began`` is the value of
        `time.perf_counter` from which the log counts seconds; now by default. ``logged`` are the
        returns in the log that an earlier recorder has read, if there was one.
        """
        self._directory = directory
        self._checkpoints = checkpoints
        self._interim = interim
        self._logger = logger
        self._logged: dict[int, int] = {}
        self._failed: set[int] = set()
        self._unwritten: list[dict[str, Any]] = []
        """Rows of the log that could not be written yet."""
        self._there = (logged or LoggedReturns(directory.path / LOG)).update()
        self._began = time.perf_counter() if began is None else began
        self._complaints = complaints
        self._keep_checkpoints = keep

    def update(self, group: Group) -> None:
        """Record a chunk of ``group``, its end, or its error."""
        if group.error is not None:
            if id(group) in self._failed:  # an earlier event was handled after the error
                return
            self._failed.add(id(group))
            for job in group.jobs:
                self._note_failure(job, short_reason(group.error))
            return
        self._log(group)
        # An event may arrive after the one at which the group was recorded.
        if group.finished and group.state is not None:
            for job, state in group.lanes():
                stays = self._keep_checkpoints and int(state.failure) == HEALTHY
                # First, so that no lane has a file but no checkpoint.
                saved = stays and self._saved(job, state, group.step)
                try:
                    final = self._final_returns(job, state)
                except Exception as error:  # too many episodes for the memory, for example
                    if not saved:
                        self._checkpoints.save_lane(job, state, group.step, kept=1)
                    why = short_reason(error)
                    self._note_failure(job, f"its final evaluation: {why}; its training is kept")
                    continue
                self._keep(job, state, final)
                if not stays:
                    self._checkpoints.discard(job)
            group.state = None  # frees the replay
            if self._interim is not None:
                self._interim.refresh()

    def _saved(self, job: Job, state: LaneState, step: int) -> bool:
        """Write the last checkpoint of a lane; a full disk does not end the training."""
        try:
            self._checkpoints.save_lane(job, state, step, kept=1)
        except UserError as error:
            warnings.warn(f"{error}; the result is written without it", stacklevel=2)
            return False
        return True

    def _log(self, group: Group) -> None:
        # A worker may be writing the curves and then the step, which is therefore read first.
        step = group.step
        assert group.returns is not None and group.metrics is not None
        rows = []
        for index, job in enumerate(group.jobs):
            cell, seed = job.key
            curve, steps = group.returns[index], evaluation_steps(cell.config)
            reached = int(np.sum(steps <= step))
            for k in range(self._logged.get(id(job), 0), reached):
                lane, value = (
                    {**cell.key, "seed": seed, "step": int(steps[k])},
                    _json_number(curve[k]),
                )
                there = self._there.get(tuple(lane.values()), math.nan)
                if there == value:
                    continue  # logged before a restart; a lane that is trained anew may differ
                row = {
                    **lane,
                    "return": value,
                    "seconds": round(time.perf_counter() - self._began, 3),
                    "metrics": {
                        name: _json_number(value)
                        for name, value in zip(
                            job.program.metric_names, group.metrics[index, k], strict=True
                        )
                    },
                }
                rows.append(row)
                if self._logger is not None:
                    self._logger.log(cell, seed, row)
            self._logged[id(job)] = reached
        self._append(rows)

    def _append(self, rows: list[dict[str, Any]]) -> None:
        """Append rows to the log; on a full disk they wait for the next attempt, with a warning."""
        path, waited = self._directory.path / LOG, self._unwritten
        self._unwritten = [*waited, *rows]
        if not self._unwritten:
            return
        try:
            if waited:
                repair_log(path)  # the failed write may have left a part of a line
            append_rows(path, self._unwritten)
        except OSError as error:
            if not waited:
                warnings.warn(
                    f"{path} cannot be written: {error.strerror}; the training continues, and "
                    "tries again later",
                    stacklevel=2,
                )
        else:
            self._unwritten = []

    def _note_failure(self, job: Job, reason: str) -> None:
        cell, seed = job.key
        self._directory.lanes.write_error(cell, seed, reason)
        self._complaints.append(f"{cell.words} seed {seed} failed: {reason}")

    def _final_returns(self, job: Job, state: LaneState) -> np.ndarray:
        """Returns, and returns of the true state: [2, episodes]; NaN if the lane was lost."""
        (cell, seed), episodes = job.key, self._directory.episodes
        if int(state.failure) != HEALTHY:
            return np.full((2, episodes), np.nan, np.float32)
        policy = job.program.policy(job.lane, state)
        return np.stack(both_returns(policy, cell.make_env(), episodes, seed))

    def _keep(self, job: Job, state: LaneState, final: np.ndarray) -> None:
        cell, seed = job.key
        failure = failure_of(seed, state)
        returns, true_returns = curves_of(cell.config, state, failure)
        interface = None
        policy = job.program.policy(job.lane, state)
        if failure is None:
            interface = policy.interface()
        else:
            self._complaints.append(
                f"{cell.words} seed {seed} was lost at step {failure.step}: {failure.reason}"
            )
        self._directory.lanes.write_lane(
            cell,
            seed,
            policy.parameters(),
            {
                "steps": evaluation_steps(cell.config),
                "returns": returns,
                "true_returns": true_returns,
                "final_returns": final[0],
                "final_true_returns": final[1],
            },
            metric_curves(cell.config, state, failure),
            None if failure is None else {"step": failure.step, "reason": failure.reason},
            interface,
        )


def _json_number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
