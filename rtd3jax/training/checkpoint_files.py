"""The files of checkpoints: one for each of the last steps, in a directory for each lane."""

import contextlib
import re
from pathlib import Path
from typing import Any

from rtd3jax.errors import UserError
from rtd3jax.system.files import read_metadata


def lane_directory(directory: Path, seed: int) -> Path:
    """The directory of a lane's checkpoints in the ``checkpoint_dir`` of a configuration."""
    return directory / f"seed-{seed}"


def checkpoint_files(directory: Path) -> list[Path]:
    """Checkpoints in ``directory``, newest first."""
    if not directory.is_dir():
        return []
    named = (file for file in directory.iterdir() if step_of(file) is not None)
    return sorted(named, key=lambda file: -(step_of(file) or 0))


def checkpoint_steps(directory: Path) -> list[int]:
    """Steps of the checkpoints in a lane's directory, newest first."""
    return [step_of(file) or 0 for file in checkpoint_files(directory)]


def step_of(file: Path) -> int | None:
    """The step of a checkpoint, from its name; None for another file."""
    match = re.fullmatch(r"step-(\d{9,})\.safetensors", file.name)
    return int(match[1]) if match else None


def unfinished_files(directory: Path) -> list[Path]:
    """Incomplete files of a process that was killed."""
    return list(directory.glob(".step-*.tmp"))


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
