"""Atomic files: each is written under a temporary name, flushed, and then renamed."""

import hashlib
import json
import os
import secrets
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from rtd3jax.errors import UserError, short_reason

_ENTRY = "rtd3jax"


def user_path(path: str | os.PathLike) -> Path:
    """``path`` with ``~`` and ``~name`` expanded; a shell does not expand them after ``--out=``.

    Raises:
        UserError: when there is no such home directory.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise UserError(f"{path}: {short_reason(error)}; write the whole path") from error


def write_bytes_atomically(path: str | os.PathLike, data: bytes) -> None:
    """Put ``data`` at ``path``; a crash at any moment leaves either the old file or the new one."""
    path = user_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Not `tempfile`: the umask and the directory's rules must decide who may read the file.
    name = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
    handle = os.open(name, flags, 0o666)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, path)
    except BaseException:
        name.unlink(missing_ok=True)
        raise


def write_text_atomically(path: str | os.PathLike, text: str) -> None:
    """Put ``text`` at ``path`` as UTF-8, as `write_bytes_atomically` does.

    A "?" replaces each byte of a path in ``text`` that is not text.
    """
    write_bytes_atomically(path, text.encode("utf-8", "replace"))


def make_writable(directory: Path) -> None:
    """Make ``directory``, and raise OSError unless files can be written in it."""
    directory.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=directory):
        pass


def check_target(path: str | os.PathLike, overwrite: bool = False) -> Path:
    """``path``, if a file may be written there.

    Raises:
        UserError: when ``path`` is a directory, or exists and ``overwrite`` is false.
    """
    path = user_path(path)
    try:
        is_directory, exists = path.is_dir(), path.exists()
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error.strerror})") from error
    if is_directory:
        raise UserError(f"{path} is a directory; name a file in it")
    if exists and not overwrite:
        raise UserError(f"{path} exists; say overwrite=True (--force) to replace it")
    return path


def check_writable(directory: Path) -> None:
    """Raise UserError if no file can be written to the directory; for use before long work."""
    if not os.access(directory, os.W_OK | os.X_OK):
        raise UserError(f"{directory} cannot be written: it is read-only for this user")


def write_new(path: str | os.PathLike, data: bytes, overwrite: bool = False) -> None:
    """Write ``data`` to ``path``; an existing file is replaced only with ``overwrite``.

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


def write_arrays(
    path: str | os.PathLike, arrays: Mapping[str, np.ndarray], metadata: object
) -> None:
    """Write arrays as safetensors, with ``metadata`` (any JSON value) and a digest of both."""
    write_bytes_atomically(path, array_bytes(arrays, metadata))


def array_bytes(arrays: Mapping[str, np.ndarray], metadata: object) -> bytes:
    """The content of the file that `write_arrays` writes."""
    arrays = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    # One entry of metadata: safetensors writes several entries in no fixed order.
    entry = json.dumps({"about": metadata, "sha256": _digest(arrays, metadata)})
    return save(arrays, {_ENTRY: entry})


def read_arrays(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], Any]:
    """The arrays and the metadata of a file that `write_arrays` wrote.

    Raises:
        UserError: when the file is missing, truncated, altered, or of another kind.
    """
    path = user_path(path)
    try:
        # safetensors reports "No such file" for any reason; `open` reports the true reason.
        path.open("rb").close()
        with safe_open(path, "numpy") as file:
            entry = json.loads((file.metadata() or {})[_ENTRY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        metadata, digest = entry["about"], entry["sha256"]
    except OSError as error:
        raise UserError(
            f"{path} cannot be read ({error.strerror or short_reason(error)})"
        ) from error
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path} cannot be read ({short_reason(error)})") from error
    if digest != _digest(arrays, metadata):
        raise UserError(f"{path} is damaged: its checksum does not agree")
    return arrays, metadata


def read_metadata(path: str | os.PathLike) -> Any:
    """The metadata of a file that `write_arrays` wrote; its arrays are neither read nor checked.

    Raises:
        UserError: when the file is missing or of another kind.
    """
    try:
        with safe_open(user_path(path), "numpy") as file:
            return json.loads((file.metadata() or {})[_ENTRY])["about"]
    except (OSError, SafetensorError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path} cannot be read ({short_reason(error)})") from error


def flatten(tree: object, prefix: str = "") -> dict[str, np.ndarray]:
    """The arrays of a nested dict under dotted names, such as ``actor.head.kernel``."""
    if not isinstance(tree, dict):
        return {prefix: np.asarray(tree)}
    flat: dict[str, np.ndarray] = {}
    for name, value in tree.items():
        flat |= flatten(value, f"{prefix}.{name}" if prefix else name)
    return flat


def unflatten(flat: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The nested dict of arrays under dotted names: the inverse of `flatten`."""
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        *parents, last = name.split(".")
        branch = tree
        for parent in parents:
            branch = branch.setdefault(parent, {})
        branch[last] = value
    return tree


def _digest(arrays: Mapping[str, np.ndarray], metadata: object) -> str:
    digest = hashlib.sha256(json.dumps(metadata, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
