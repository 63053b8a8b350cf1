"""Files that are whole or absent: written beside their place, flushed, and moved there."""

import hashlib
import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from rtd3jax.errors import UserError, first_line

_ENTRY = "rtd3jax"


def user_path(path: str | os.PathLike) -> Path:
    """``path`` with ``~`` and ``~name`` expanded: a shell does not do so after ``--out=``.

    Raises:
        UserError: when there is no such home directory.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise UserError(f"{path}: {first_line(error)}; write the whole path") from error


def write_bytes_atomically(path: str | os.PathLike, data: bytes) -> None:
    """Put ``data`` at ``path``; a crash at any moment leaves either the old file or the new one."""
    path = user_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Opened as any file is, so that the umask and the directory's rules say who may read it.
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


def check_target(path: str | os.PathLike, overwrite: bool = False) -> Path:
    """``path``, if a file may be put there.

    Raises:
        UserError: when it is a directory, or exists and is not to be replaced.
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


def write_arrays(path: str | os.PathLike, arrays: Mapping[str, np.ndarray], about: object) -> None:
    """Write arrays as safetensors, with ``about`` (anything JSON) and a digest of the whole."""
    write_bytes_atomically(path, array_bytes(arrays, about))


def array_bytes(arrays: Mapping[str, np.ndarray], about: object) -> bytes:
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
    path = user_path(path)
    try:
        # safetensors says "No such file" whatever the reason, and the system says the true one.
        path.open("rb").close()
        with safe_open(path, "numpy") as file:
            entry = json.loads((file.metadata() or {})[_ENTRY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        about, digest = entry["about"], entry["sha256"]
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror or first_line(error)})") from error
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path} cannot be read ({first_line(error)})") from error
    if digest != _digest(arrays, about):
        raise UserError(f"{path} is damaged: its checksum does not agree")
    return arrays, about


def read_about(path: str | os.PathLike) -> Any:
    """What `write_arrays` was told about the arrays; these are not read, and nothing is checked.

    Raises:
        UserError: when the file is missing or something else.
    """
    try:
        with safe_open(user_path(path), "numpy") as file:
            return json.loads((file.metadata() or {})[_ENTRY])["about"]
    except (OSError, SafetensorError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path} cannot be read ({first_line(error)})") from error


def flatten(tree: object, prefix: str = "") -> dict[str, np.ndarray]:
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


def _digest(arrays: Mapping[str, np.ndarray], about: object) -> str:
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
