"""Checkpoints of lanes: everything that a lane is, so that it goes on to the bit.

A lane's checkpoint is one file, written beside its place and moved there, with a checksum; the
last two are kept. It is a safetensors file: reading it cannot run code. A lane has no hidden
state: its random numbers are a function of seed and step, and how its steps are cut into chunks
is immaterial, so a lane that goes on from a checkpoint ends with the same bits.
"""

import re
import time
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.errors import UserError
from rtd3jax.system.files import read_arrays, write_arrays
from rtd3jax.system.versions import versions_of
from rtd3jax.training.loop import Lane, LaneState, Program

DEFAULT_SECONDS = 300.0
"""Between checkpoints of a lane, unless they are so large that they take their time."""

_PATIENCE = 150
"""A checkpoint waits by default for this many times what the last one took: with five lanes on two
cores they cost 2% at most, however large the replay."""

KEPT = 2
_FORMAT = 1


class Checkpoints:
    """Where lanes keep their checkpoints, and how often.

    Args:
        directory_of: a lane's own directory.
        identity_of: what the lane is, JSON-ready; a checkpoint of something else is refused.
        seconds: between checkpoints of a lane; None for `DEFAULT_SECONDS`, or longer where a
            checkpoint takes long; infinity for none by time.
        steps: between checkpoints of a lane; None for none by steps.
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
        self._written: dict[int, tuple[float, int]] = {}
        self._cost: dict[int, float] = {}

    def is_due(self, group: Any) -> bool:
        """Whether the group's last checkpoint, or its start, is long enough ago."""
        now = time.monotonic()
        when, step = self._written.setdefault(id(group), (now, 0))
        seconds = self._seconds
        if seconds is None:
            seconds = max(DEFAULT_SECONDS, _PATIENCE * self._cost.get(id(group), 0.0))
        by_time = now - when >= seconds
        return by_time or (self._steps is not None and group.step - step >= self._steps)

    def save(self, jobs: Iterable[tuple[Any, LaneState]], group: Any, step: int) -> None:
        """Write a checkpoint of each lane at ``step``, then drop those before the last two."""
        began = time.monotonic()
        for job, state in jobs:
            directory = self._directory_of(job)
            about = {
                "format": _FORMAT,
                "step": step,
                "identity": self._identity_of(job),
                "versions": versions(),
            }
            try:
                directory.mkdir(parents=True, exist_ok=True)
                write_arrays(directory / f"step-{step:09d}.safetensors", to_arrays(state), about)
            except OSError as error:
                raise UserError(
                    f"checkpoint in {directory} cannot be written: {error.strerror}; "
                    "the one before it is kept"
                ) from error
            for old in [*_files(directory)[KEPT:], *_unfinished(directory)]:
                old.unlink(missing_ok=True)
        now = time.monotonic()
        self._written[id(group)] = (now, step)
        self._cost[id(group)] = now - began

    def restore(self, jobs: list[Any]) -> tuple[list[LaneState], int] | None:
        """The newest step at which all these lanes have a sound checkpoint; None for a new start.

        Raises:
            UserError: when a checkpoint belongs to something else, or none of those there is sound.
        """
        found = [self._readable(job, first=len(jobs) == 1) for job in jobs]
        common = set.intersection(*(set(steps) for steps in found))
        if not common:
            if any(found):
                warnings.warn(
                    "lanes that now advance together have no checkpoint of a common step: "
                    "they start over",
                    stacklevel=2,
                )
            return None
        step = max(common)
        return [steps[step] for steps in found], step

    def discard(self, job: Any) -> None:
        """Remove a lane's checkpoints: it has ended, and its result is kept."""
        directory = self._directory_of(job)
        for file in [*_files(directory), *_unfinished(directory)]:
            file.unlink(missing_ok=True)
        if directory.is_dir() and not any(directory.iterdir()):
            directory.rmdir()

    def _readable(self, job: Any, first: bool) -> dict[int, LaneState]:
        """A lane's sound checkpoints by step, or the newest one; warns of damaged ones."""
        states, complaints = {}, []
        for file in _files(self._directory_of(job)):
            try:
                arrays, about = read_arrays(file)
            except UserError as error:
                complaints.append(str(error))
                continue
            self._check(file, about, job)
            states[int(about["step"])] = from_arrays(arrays, job.program, job.lane, file)
            if first:
                break
        if complaints and not states:
            raise UserError(
                f"{'; '.join(complaints)}; no older checkpoint is left: remove "
                f"{self._directory_of(job)} to start this lane over"
            )
        for complaint in complaints:
            warnings.warn(f"{complaint}; an older checkpoint is used", stacklevel=2)
        return states

    def _check(self, file: Path, about: Any, job: Any) -> None:
        here = {
            "format": _FORMAT,
            "identity": self._identity_of(job),
            "versions": versions(),
        }
        for name, value in here.items():
            there = about.get(name) if isinstance(about, dict) else None
            if there != value:
                raise UserError(
                    f"{file} is of another {name} ({_difference(there, value)}); "
                    "use what made it, or start over"
                )


def versions() -> dict[str, str]:
    """Versions on which a lane's bits depend."""
    return versions_of(("rtd3jax", "jax", "jaxlib"))


def checkpoint_steps(directory: Path) -> list[int]:
    """Steps of the checkpoints in a lane's directory, newest first."""
    return [_step(file) or 0 for file in _files(directory)]


def to_arrays(state: LaneState) -> dict[str, np.ndarray]:
    """The leaves under the names of their places; typed keys as their data."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path): _to_array(leaf) for path, leaf in leaves}


def from_arrays(
    arrays: dict[str, np.ndarray], program: Program, lane: Lane, file: Path
) -> LaneState:
    """The state that `to_arrays` took apart, checked against what the program expects."""
    expected = jax.eval_shape(program.init, lane)
    leaves, structure = jax.tree_util.tree_flatten_with_path(expected)
    names = [jax.tree_util.keystr(path) for path, _ in leaves]
    if set(names) != set(arrays):
        odd = sorted(set(names) ^ set(arrays))[0]
        raise UserError(f"{file} does not fit this agent: array {odd} is missing or too many")
    return jax.tree.unflatten(
        structure,
        [_from_array(arrays[n], leaf, n, file) for n, (_, leaf) in zip(names, leaves, strict=True)],
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


def _files(directory: Path) -> list[Path]:
    """Checkpoints in ``directory``, newest first."""
    if not directory.is_dir():
        return []
    named = (file for file in directory.iterdir() if _step(file) is not None)
    return sorted(named, key=lambda file: -(_step(file) or 0))


def _unfinished(directory: Path) -> list[Path]:
    """What a killed process left half-written."""
    return list(directory.glob(".step-*.tmp"))


def _step(file: Path) -> int | None:
    match = re.fullmatch(r"step-(\d{9,})\.safetensors", file.name)
    return int(match[1]) if match else None


def _difference(there: object, here: object) -> str:
    if isinstance(there, dict) and isinstance(here, dict):
        for name in {**there, **here}:
            if there.get(name) != here.get(name):
                return f"{name}: {_difference(there.get(name), here.get(name))}"
    return f"{there} there, {here} here"
