"""Files that are whole or absent: written beside their place, flushed, and moved there."""

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from rtd3jax.errors import UserError

_ENTRY = "rtd3jax"


def write_bytes_atomically(path: str | os.PathLike, data: bytes) -> None:
    """Put ``data`` at ``path``; a crash at any moment leaves either the old file or the new one."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def check_target(path: str | os.PathLike, overwrite: bool = False) -> Path:
    """``path``, if a file may be put there.

    Raises:
        UserError: when it is a directory, or exists and is not to be replaced.
    """
    path = Path(path)
    if path.is_dir():
        raise UserError(f"{path} is a directory; name a file in it")
    if path.exists() and not overwrite:
        raise UserError(f"{path} exists; say overwrite=True (--force) to replace it")
    return path


def write_new(path: str | os.PathLike, data: bytes, overwrite: bool = False) -> None:
    """Put ``data`` where the user wants it; nothing is replaced unasked.

    Raises:
        UserError: as `check_target` does, or when the file cannot be written.
    """
    path = check_target(path, overwrite)
    try:
        write_bytes_atomically(path, data)
    except OSError as error:
        raise UserError(
            f"{path} cannot be written ({error.filename or path}: {error.strerror})"
        ) from error


def write_arrays(path: str | os.PathLike, arrays: Mapping[str, np.ndarray], about: Any) -> None:
    """Write arrays as safetensors, with ``about`` (anything JSON) and a digest of the whole."""
    write_bytes_atomically(path, array_bytes(arrays, about))


def array_bytes(arrays: Mapping[str, np.ndarray], about: Any) -> bytes:
    """The content of the file that `write_arrays` writes."""
    arrays = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    # One entry of metadata, because several would be written in no fixed order.
    entry = json.dumps({"about": about, "sha256": _digest(arrays, about)})
    return save(arrays, {_ENTRY: entry})


def read_arrays(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], Any]:
    """What `write_arrays` wrote.

    Raises:
        UserError: when the file is missing, truncated, altered, or something else.
    """
    try:
        with safe_open(path, "numpy") as file:
            entry = json.loads((file.metadata() or {})[_ENTRY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        about, digest = entry["about"], entry["sha256"]
    except (OSError, SafetensorError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path} cannot be read ({str(error).splitlines()[0]})") from error
    if digest != _digest(arrays, about):
        raise UserError(f"{path} is damaged: its checksum does not agree")
    return arrays, about


def flatten(tree: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """A nested dict's arrays under dotted names."""
    if not isinstance(tree, dict):
        return {prefix: np.asarray(tree)}
    flat: dict[str, np.ndarray] = {}
    for name, value in tree.items():
        flat |= flatten(value, f"{prefix}.{name}" if prefix else name)
    return flat


def unflatten(flat: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The nested dict of dotted names."""
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        *parents, last = name.split(".")
        branch = tree
        for parent in parents:
            branch = branch.setdefault(parent, {})
        branch[last] = value
    return tree


def _digest(arrays: Mapping[str, np.ndarray], about: Any) -> str:
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
