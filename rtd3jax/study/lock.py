"""One writer for a run directory, or one for each shard of it; one at a time for its tables.

The lock is the operating system's (flock): it goes when its process goes, however that ends.
"""

import contextlib
import fcntl
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path

from rtd3jax.errors import UserError


def parse_shard(text: str) -> tuple[int, int]:
    """``"2/4"`` as (2, 4): the second of four shares."""
    match = re.fullmatch(r"\s*(\d{1,6})\s*/\s*(\d{1,6})\s*", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UserError(f"--shard {text!r} is not of the form i/n with 1 <= i <= n")
    return int(match[1]), int(match[2])


@contextlib.contextmanager
def writer(directory: Path, shard: tuple[int, int] | None) -> Iterator[None]:
    """Hold the directory: alone, or beside writers of other shards.

    Raises:
        UserError: when another process holds it, or the same shard of it.
    """
    with contextlib.ExitStack() as stack:
        whole = "another process is writing to it"
        if shard is None:
            _hold(stack, directory, directory / ".lock", fcntl.LOCK_EX, whole)
        else:
            _hold(stack, directory, directory / ".lock", fcntl.LOCK_SH, whole)
            name = f".lock-{shard[0]}-of-{shard[1]}"
            taken = f"another process is writing shard {shard[0]}/{shard[1]} of it"
            _hold(stack, directory, directory / name, fcntl.LOCK_EX, taken)
        yield


@contextlib.contextmanager
def deriver(directory: Path) -> Iterator[None]:
    """Wait for, and hold, the right to write the tables that all shards have in common."""
    with contextlib.ExitStack() as stack:
        handle = _open(directory, directory / ".lock-tables")
        stack.callback(os.close, handle)
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def is_held(directory: Path) -> bool:
    """Whether a process is writing to the directory now."""
    try:
        handle = os.open(directory / ".lock", os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    else:
        return False
    finally:
        os.close(handle)


def _hold(stack: contextlib.ExitStack, directory: Path, path: Path, kind: int, reason: str) -> None:
    handle = _open(directory, path)
    stack.callback(os.close, handle)
    for patience in (0.1, 0.2, None):  # --status looks at a lock by holding it for a moment
        try:
            fcntl.flock(handle, kind | fcntl.LOCK_NB)
            return
        except BlockingIOError as error:
            if patience is None:
                raise UserError(
                    f"--out {directory}: {reason}; wait for it, or use --shard i/n"
                ) from error
            time.sleep(patience)


def _open(directory: Path, path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        raise UserError(f"--out {directory} cannot be written: {error.strerror}") from error
