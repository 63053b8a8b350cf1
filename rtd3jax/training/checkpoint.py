"""Checkpoints of lanes, from which training continues as if it had not been interrupted.

A checkpoint of a lane is one safetensors file with a checksum; reading it cannot run code. The file
is written under a temporary name and then renamed, and the last two are kept. A lane has no state
outside the checkpoint: its random numbers are a function of seed and step, and the division of its
steps into chunks has no effect. So a lane that continues from a checkpoint ends with the same bits,
if the process may use the same number of cores on the same kind of processor: XLA divides long sums
by this number. Otherwise it differs by rounding.
"""

import time
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from rtd3jax.errors import UserError
from rtd3jax.system.files import make_writable, read_arrays, write_arrays
from rtd3jax.system.jax_settings import jax_settings
from rtd3jax.system.machine import cores
from rtd3jax.system.versions import versions_of
from rtd3jax.training.checkpoint_arrays import extended, from_arrays, to_arrays
from rtd3jax.training.checkpoint_files import (
    checkpoint_files,
    checkpoint_steps,
    newest_metadata,
    step_of,
    unfinished_files,
)
from rtd3jax.training.groups import Group
from rtd3jax.training.jobs import Job
from rtd3jax.training.lane import LaneState
from rtd3jax.training.lane_identity import difference, is_longer, same, why_not_longer
from rtd3jax.training.plant import PLANT

DEFAULT_SECONDS = 300.0
"""Default time between two checkpoints of a lane; longer if writing one takes long."""

_PATIENCE = 150
"""By default, the time between checkpoints is at least this many times the time that the last one
took. With up to six lanes on two cores, checkpoints then take at most 2% of the time."""

_SHARE = 0.02
"""Largest part of the time of all cores that checkpoints take by default."""

KEPT = 2

_FORMAT = 1


class Checkpoints:
    """Writes and reads the checkpoints of lanes.

    Args:
        directory_of: returns the directory of a lane.
        identity_of: returns the identity of a lane, JSON-ready; a checkpoint with another identity
            is refused.
        seconds: time between two checkpoints of a lane; None for `DEFAULT_SECONDS`, or longer if a
            checkpoint takes long; infinity for no limit of time.
        steps: steps between two checkpoints of a lane; None for no limit of steps.
    """

    def __init__(
        self,
        directory_of: Callable[[Job], Path],
        identity_of: Callable[[Job], dict[str, Any]],
        seconds: float | None = None,
        steps: int | None = None,
    ):
        self._directory_of = directory_of
        self._identity_of = identity_of
        self._seconds = seconds
        self._steps = steps
        self._written: dict[int, int] = {}
        self._tried: dict[int, tuple[float, int]] = {}
        self._cost: dict[int, float] = {}
        self._asked: dict[int, Group] = {}

    def is_due(self, group: Group) -> bool:
        """Whether the group needs a new checkpoint."""
        now = time.monotonic()
        when, step = self._tried.setdefault(id(group), (now, 0))
        seconds = self._seconds
        if seconds is None:
            self._asked[id(group)] = group
            training = sum(not other.finished for other in list(self._asked.values()))
            patience = max(_PATIENCE, training / (_SHARE * cores()))
            seconds = max(DEFAULT_SECONDS, patience * self._cost.get(id(group), 0.0))
        by_time = now - when >= seconds
        return by_time or (self._steps is not None and group.step - step >= self._steps)

    def save(self, group: Group) -> None:
        """Write a checkpoint of each lane of ``group``.

        Raises:
            UserError: when a checkpoint cannot be written; the others are written.
        """
        began = time.monotonic()
        # After an error, too, the next attempt is after the usual time.
        self._tried[id(group)] = (began, group.step)
        _each(lambda lane: self.save_lane(lane[0], lane[1], group.step), group.lanes())
        self.note(group, group.step)
        self._cost[id(group)] = time.monotonic() - began

    def save_lane(self, job: Job, state: LaneState, step: int, kept: int = KEPT) -> None:
        """Write a checkpoint of a lane at ``step``; then remove all but the last ``kept``."""
        directory = self._directory_of(job)
        metadata = {
            "format": _FORMAT,
            "step": step,
            "identity": self._identity_of(job),
            "versions": versions(),
            "settings": dict(jax_settings()),
        }
        file = directory / f"step-{step:09d}.safetensors"
        before = [old for old in checkpoint_files(directory) if old != file]
        try:
            directory.mkdir(parents=True, exist_ok=True)
            write_arrays(file, to_arrays(state), metadata)
        except OSError as error:
            remark = "; the previous checkpoint is kept" if before else ""
            raise _unwritable(directory, error, remark) from error
        # Files of later steps were written before a lane started over: no lane continues from them.
        earlier = [old for old in before if (step_of(old) or 0) < step]
        stale = [old for old in before if old not in earlier[: kept - 1]]
        for old in [*stale, *unfinished_files(directory)]:
            old.unlink(missing_ok=True)

    def check(self, job: Job, *, whole: bool = False) -> None:
        """Raise UserError if the lane's newest checkpoint belongs to another identity.

        `restore` raises it too, but in a worker, while other lanes train. Only metadata are read
        here, and damaged files are left to `restore`. With ``whole``, the files are read until one
        is valid, and it is also an error if none is.
        """
        directory = self._directory_of(job)
        if not whole:
            newest = newest_metadata(directory)
            if newest is not None:
                self._check(*newest, job)
            return
        complaints = []
        for file in checkpoint_files(directory):
            try:
                _, metadata = read_arrays(file)
            except UserError as error:
                complaints.append(str(error))
                continue
            self._check(file, metadata, job)
            return
        if complaints:
            raise _none_valid(directory, complaints)

    def prepare(self, jobs: Iterable[Job]) -> None:
        """Make the directory of each lane, and raise UserError if it cannot be written."""
        for job in jobs:
            directory = self._directory_of(job)
            try:
                make_writable(directory)
            except OSError as error:
                raise _unwritable(directory, error) from error

    def note(self, group: Group, step: int) -> None:
        """Note that each lane of ``group`` has a checkpoint at ``step``."""
        self._written[id(group)] = step
        self._tried[id(group)] = (time.monotonic(), step)

    def save_once(self, group: Group) -> None:
        """Write a checkpoint of each lane of ``group``, unless its last one is at this step."""
        if self._written.get(id(group)) != group.step:
            self.save(group)

    def save_all(self, groups: Iterable[Group]) -> None:
        """`save_once` for each group; an error is raised after all others are written."""
        _each(self.save_once, groups)

    def restore(self, jobs: list[Job]) -> tuple[list[LaneState], int] | None:
        """The states at the newest step with a valid checkpoint of every lane, and this step.

        Returns None if the lanes must start from the beginning.

        Raises:
            UserError: when a checkpoint has another identity, or no checkpoint is valid.
        """
        found = [self._readable(job, first=len(jobs) == 1) for job in jobs]
        common = set.intersection(*(set(steps) for steps in found))
        if not common:
            if any(found):
                starts = dict.fromkeys(job.start.about for job in jobs if job.start is not None)
                warnings.warn(
                    "lanes that now advance together have no checkpoint at a common step: they "
                    f"start from the beginning{', with the ' if starts else ''}"
                    f"{' and the '.join(starts)}",
                    stacklevel=2,
                )
            return None
        step = max(common)
        return [steps[step] for steps in found], step

    def steps(self, job: Job) -> set[int]:
        """The steps of a lane's checkpoints, valid or not."""
        return set(checkpoint_steps(self._directory_of(job)))

    def discard(self, job: Job) -> None:
        """Remove the checkpoints of a lane that has ended and whose result is saved."""
        directory = self._directory_of(job)
        for file in [*checkpoint_files(directory), *unfinished_files(directory)]:
            file.unlink(missing_ok=True)
        if directory.is_dir() and not any(directory.iterdir()):
            directory.rmdir()

    def _readable(self, job: Job, first: bool) -> dict[int, LaneState]:
        """A lane's valid checkpoints by step, or only the newest; warns of damaged ones."""
        states, complaints = {}, []
        for file in checkpoint_files(self._directory_of(job)):
            try:
                arrays, metadata = read_arrays(file)
            except UserError as error:
                complaints.append(str(error))
                continue
            longer = self._check(file, metadata, job)
            if longer:
                arrays = extended(arrays, job.program, job.lane)
            states[int(metadata["step"])] = from_arrays(arrays, job.program, job.lane, file)
            if first:
                break
        if complaints and not states:
            raise _none_valid(self._directory_of(job), complaints)
        for complaint in complaints:
            warnings.warn(f"{complaint}; an older checkpoint is used", stacklevel=2)
        return states

    def _check(self, file: Path, metadata: Any, job: Job) -> bool:
        """Check the identity of a checkpoint; return whether the lane has more steps now."""
        here: dict[str, Any] = {
            "format": _FORMAT,
            "identity": self._identity_of(job),
            "versions": versions(),
            "settings": dict(jax_settings()),
        }
        # Checkpoints of earlier versions do not name JAX's settings, which were the defaults.
        there = {"settings": {}, **(metadata if isinstance(metadata, dict) else {})}
        if PLANT not in (there.get("identity") or {}):
            here["identity"] = {n: x for n, x in here["identity"].items() if n != PLANT}
        longer = is_longer(there.get("identity"), here["identity"])
        if longer:
            reason = why_not_longer(there["identity"], here["identity"], int(there["step"]))
            if reason is not None:
                raise UserError(
                    f"{file} cannot continue to more steps: {reason}; start from the beginning"
                )
            del here["identity"]
        for name, value in here.items():
            if not same(there.get(name), value):
                raise UserError(
                    f"{file} belongs to another {name} ({difference(there.get(name), value)}); "
                    f"use the same {name}, or start from the beginning"
                )
        return longer


def _each(write: Callable[[Any], None], items: Iterable[Any]) -> None:
    """Call ``write`` for every item; raise the first UserError when all were tried."""
    errors = []
    for item in items:
        try:
            write(item)
        except UserError as error:
            errors.append(error)
    if errors:
        raise errors[0]


def _none_valid(directory: Path, complaints: Iterable[str]) -> UserError:
    return UserError(
        f"{'; '.join(complaints)}; there is no older checkpoint: remove {directory} to start this "
        "lane from the beginning"
    )


def _unwritable(directory: Path, error: OSError, remark: str = "") -> UserError:
    return UserError(f"checkpoint in {directory} cannot be written: {error.strerror}{remark}")


def versions() -> dict[str, str]:
    """Versions of the packages, which also determine a lane's results."""
    return versions_of(("rtd3jax", "jax", "jaxlib"))
