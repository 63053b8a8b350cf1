"""Checkpoints of lanes, from which training continues as if it had not been interrupted.

A checkpoint of a lane is one safetensors file with a checksum; reading it cannot run code. The file
is written under a temporary name and then renamed, and the last two are kept. A lane has no state
outside the checkpoint: its random numbers are a function of seed and step, and the division of its
steps into chunks has no effect. So a lane that continues from a checkpoint ends with the same bits,
if the process may use the same number of cores on the same kind of processor: XLA divides long sums
by this number. Otherwise it differs by rounding.
"""

import contextlib
import json
import re
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.envs.compat.simulated import release
from rtd3jax.errors import UserError
from rtd3jax.system.files import read_arrays, read_metadata, write_arrays
from rtd3jax.system.jax_settings import jax_settings
from rtd3jax.system.versions import versions_of
from rtd3jax.training.loop import Lane, LaneState, Program
from rtd3jax.training.plant import PLANT

DEFAULT_SECONDS = 300.0
"""Default time between two checkpoints of a lane; longer if writing one takes long."""

_PATIENCE = 150
"""By default, the time between checkpoints is at least this many times the time that the last one
took. With five lanes on two cores, checkpoints then take at most 2% of the time."""

KEPT = 2
LONGER = ("total_steps", "replay_capacity")
"""Fields of the configuration that may increase when a lane continues from its checkpoint."""
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
        directory_of: Callable[[Any], Path],
        identity_of: Callable[[Any], dict[str, Any]],
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

    def is_due(self, group: Any) -> bool:
        """Whether the group needs a new checkpoint."""
        now = time.monotonic()
        when, step = self._tried.setdefault(id(group), (now, 0))
        seconds = self._seconds
        if seconds is None:
            seconds = max(DEFAULT_SECONDS, _PATIENCE * self._cost.get(id(group), 0.0))
        by_time = now - when >= seconds
        return by_time or (self._steps is not None and group.step - step >= self._steps)

    def save(self, group: Any) -> None:
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

    def save_lane(self, job: Any, state: LaneState, step: int, kept: int = KEPT) -> None:
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
        earlier = [old for old in before if (_step(old) or 0) < step]
        stale = [old for old in before if old not in earlier[: kept - 1]]
        for old in [*stale, *_unfinished(directory)]:
            old.unlink(missing_ok=True)

    def check(self, job: Any) -> None:
        """Raise UserError if the lane's newest checkpoint belongs to another identity.

        `restore` raises it too, but in a worker, while other lanes train. Only metadata are read
        here; damaged files are left to `restore`.
        """
        newest = newest_metadata(self._directory_of(job))
        if newest is not None:
            self._check(*newest, job)

    def prepare(self, jobs: Iterable[Any]) -> None:
        """Make the directory of each lane, and raise UserError if it cannot be written."""
        for job in jobs:
            directory = self._directory_of(job)
            try:
                directory.mkdir(parents=True, exist_ok=True)
                with tempfile.TemporaryFile(dir=directory):
                    pass
            except OSError as error:
                raise _unwritable(directory, error) from error

    def note(self, group: Any, step: int) -> None:
        """Note that each lane of ``group`` has a checkpoint at ``step``."""
        self._written[id(group)] = step
        self._tried[id(group)] = (time.monotonic(), step)

    def save_once(self, group: Any) -> None:
        """Write a checkpoint of each lane of ``group``, unless its last one is at this step."""
        if self._written.get(id(group)) != group.step:
            self.save(group)

    def save_all(self, groups: Iterable[Any]) -> None:
        """`save_once` for each group; an error is raised after all others are written."""
        _each(self.save_once, groups)

    def restore(self, jobs: list[Any]) -> tuple[list[LaneState], int] | None:
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

    def steps(self, job: Any) -> set[int]:
        """The steps of a lane's checkpoints, valid or not."""
        return set(checkpoint_steps(self._directory_of(job)))

    def discard(self, job: Any) -> None:
        """Remove the checkpoints of a lane that has ended and whose result is saved."""
        directory = self._directory_of(job)
        for file in [*checkpoint_files(directory), *_unfinished(directory)]:
            file.unlink(missing_ok=True)
        if directory.is_dir() and not any(directory.iterdir()):
            directory.rmdir()

    def _readable(self, job: Any, first: bool) -> dict[int, LaneState]:
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
                arrays = _extended(arrays, job.program, job.lane)
            states[int(metadata["step"])] = from_arrays(arrays, job.program, job.lane, file)
            if first:
                break
        if complaints and not states:
            raise UserError(
                f"{'; '.join(complaints)}; there is no older checkpoint: remove "
                f"{self._directory_of(job)} to start this lane from the beginning"
            )
        for complaint in complaints:
            warnings.warn(f"{complaint}; an older checkpoint is used", stacklevel=2)
        return states

    def _check(self, file: Path, metadata: Any, job: Any) -> bool:
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


def same(one: object, other: object) -> bool:
    """Whether two JSON-ready values are the same; NaN is the same as NaN."""
    return json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True)


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


def _unwritable(directory: Path, error: OSError, remark: str = "") -> UserError:
    return UserError(f"checkpoint in {directory} cannot be written: {error.strerror}{remark}")


def is_longer(before: Any, after: Mapping[str, Any]) -> bool:
    """Whether ``after``, the identity of a lane, equals ``before`` except for more steps."""
    if not isinstance(before, dict) or before.keys() != after.keys():
        return False
    changed = {name for name in after if not same(before[name], after[name])}
    return (
        "total_steps" in changed
        and changed <= set(LONGER)
        and before["total_steps"] < after["total_steps"]
    )


def why_not_longer(before: Mapping[str, Any], after: Mapping[str, Any], step: int) -> str | None:
    """Why a lane cannot continue to more steps with the results of an uninterrupted training.

    Args:
        before: the configuration of the steps so far.
        after: the configuration with more steps.
        step: number of steps so far.

    Returns:
        The reason, with the field that causes it; None if the lane can continue.
    """
    fraction, slots = before["final_learning_rate_fraction"], before["replay_capacity"]
    if fraction != 1.0:
        return (
            f"its learning rates have been falling towards step {before['total_steps']:,} "
            f"(final_learning_rate_fraction: {fraction})"
        )
    if slots != after["replay_capacity"] and (step > slots or slots > after["replay_capacity"]):
        return f"replay_capacity: {slots} there, {after['replay_capacity']} here"
    if step == before["total_steps"] and step % before["eval_every"]:
        return (
            f"its last evaluation, at step {step:,}, is not a multiple of eval_every "
            f"({before['eval_every']:,})"
        )
    return None


def versions() -> dict[str, str]:
    """Versions of the packages, which also determine a lane's results."""
    return versions_of(("rtd3jax", "jax", "jaxlib"))


def lane_directory(directory: Path, seed: int) -> Path:
    """The directory of a lane's checkpoints in the ``checkpoint_dir`` of a configuration."""
    return directory / f"seed-{seed}"


def newest_metadata(directory: Path) -> tuple[Path, Any] | None:
    """The newest checkpoint in a lane's directory whose metadata can be read, and these."""
    for file in checkpoint_files(directory):
        with contextlib.suppress(UserError):
            return file, read_metadata(file)
    return None


def identity_there(directory: Path) -> dict[str, Any]:
    """The identity in the newest readable checkpoint in a lane's directory; empty without one."""
    _, metadata = newest_metadata(directory) or (None, None)
    identity = metadata.get("identity") if isinstance(metadata, dict) else None
    return identity if isinstance(identity, dict) else {}


def checkpoint_steps(directory: Path) -> list[int]:
    """Steps of the checkpoints in a lane's directory, newest first."""
    return [_step(file) or 0 for file in checkpoint_files(directory)]


def to_arrays(state: LaneState) -> dict[str, np.ndarray]:
    """The leaves by their paths in the state; typed keys as their data."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path): _to_array(leaf) for path, leaf in leaves}


def _extended(arrays: dict[str, np.ndarray], program: Program, lane: Lane) -> dict[str, np.ndarray]:
    """Arrays of a lane that has more steps now, extended with the values of a new lane."""

    def longer(lane: Lane) -> dict[str, jax.Array]:
        state = program.init(lane)
        release(program.env, state.env_state)  # nobody plays the episodes that begin here
        leaves = jax.tree_util.tree_leaves_with_path(state)
        named = {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
        return {
            name: leaf
            for name, leaf in named.items()
            if name in arrays and not _is_key(leaf) and _is_head(arrays[name].shape, leaf.shape)
        }

    tails = {n: np.asarray(leaf)[len(arrays[n]) :] for n, leaf in jax.jit(longer)(lane).items()}
    return {
        name: np.concatenate([array, tails[name]]) if name in tails else array
        for name, array in arrays.items()
    }


def _is_head(short: tuple[int, ...], long: tuple[int, ...]) -> bool:
    """Whether an array of shape ``short`` can be the beginning of an array of shape ``long``."""
    return len(short) == len(long) > 0 and short[0] < long[0] and short[1:] == long[1:]


def from_arrays(
    arrays: dict[str, np.ndarray], program: Program, lane: Lane, file: Path
) -> LaneState:
    """The state from the arrays of `to_arrays`, checked against the program's state."""
    return leaves_from_arrays(jax.eval_shape(program.init, lane), arrays, "", file)


def leaves_from_arrays(expected: Any, arrays: dict[str, np.ndarray], place: str, file: Path) -> Any:
    """A part of a state with the structure of ``expected``, from the arrays under ``place``.

    With an empty ``place``, it is the whole state.

    Raises:
        UserError: when the arrays under ``place`` do not have this structure.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(expected)
    named = [(place + jax.tree_util.keystr(path), leaf) for path, leaf in leaves]
    there = {name for name in arrays if not place or name.startswith((f"{place}.", f"{place}["))}
    if odd := sorted(there ^ {name for name, _ in named}):
        raise UserError(f"{file} does not fit this agent: array {odd[0]} is missing or unexpected")
    return jax.tree.unflatten(
        structure, [_from_array(arrays[name], leaf, name, file) for name, leaf in named]
    )


def _is_key(leaf: jax.Array) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _to_array(leaf: jax.Array) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _from_array(array: np.ndarray, leaf: jax.Array, name: str, file: Path) -> jax.Array:
    if _is_key(leaf):
        dtype: Any = leaf.dtype
        value = jax.random.wrap_key_data(jnp.asarray(array), impl=dtype._impl.name)
    else:
        value = jnp.asarray(array)
    if value.shape != leaf.shape or value.dtype != leaf.dtype:
        raise UserError(
            f"{file} does not fit this agent: array {name} is {value.dtype}{list(value.shape)}, "
            f"not {leaf.dtype}{list(leaf.shape)}"
        )
    return value


def checkpoint_files(directory: Path) -> list[Path]:
    """Checkpoints in ``directory``, newest first."""
    if not directory.is_dir():
        return []
    named = (file for file in directory.iterdir() if _step(file) is not None)
    return sorted(named, key=lambda file: -(_step(file) or 0))


def _unfinished(directory: Path) -> list[Path]:
    """Incomplete files of a process that was killed."""
    return list(directory.glob(".step-*.tmp"))


def _step(file: Path) -> int | None:
    match = re.fullmatch(r"step-(\d{9,})\.safetensors", file.name)
    return int(match[1]) if match else None


def difference(there: object, here: object) -> str:
    """The first difference of two JSON-ready values, in words."""
    if isinstance(there, dict) and isinstance(here, dict):
        for name in {**there, **here}:
            if not same(there.get(name), here.get(name)):
                return f"{name}: {difference(there.get(name), here.get(name))}"
    return f"{there} there, {here} here"
