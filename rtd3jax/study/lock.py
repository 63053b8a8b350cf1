"""Locks of a run directory: one writer in total or per shard, and one writer of its tables.

The operating system releases a lock when its process ends for any reason.
"""

import contextlib
import errno
import os
import re
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

from rtd3jax.errors import UserError
from rtd3jax.study.filelock import lock, open_for_locking


def parse_shard(text: str) -> tuple[int, int]:
    """Parse ``"2/4"`` as (2, 4), the second of four shards; UserError for any other form."""
    match = re.fullmatch(r"\s*(\d{1,6})\s*/\s*(\d{1,6})\s*", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UserError(f"--shard {text!r} is not of the form i/n with 1 <= i <= n")
    return int(match[1]), int(match[2])


@contextlib.contextmanager
def writer(directory: Path, shard: tuple[int, int] | None) -> Iterator[list[int]]:
    """Hold the lock of the directory, or of one of its shards; yield the handles of its files.

    On POSIX, a process that inherits the handles holds the lock too, until it ends.

    Raises:
        UserError: when another process holds the same lock.
    """
    with contextlib.ExitStack() as stack:
        whole = "another process is writing to it"
        handles = [_hold(stack, directory, directory / ".lock", shard is not None, whole)]
        if shard is not None:
            _refuse_other_divisions(directory, shard[1])
            name = f".lock-{shard[0]}-of-{shard[1]}"
            taken = f"another process is writing shard {shard[0]}/{shard[1]} of it"
            handles.append(_hold(stack, directory, directory / name, False, taken))
            # Of two divisions that start together, each may not have had its lock before.
            _refuse_other_divisions(directory, shard[1])
        yield handles


def _refuse_other_divisions(directory: Path, count: int) -> None:
    """Raise UserError while a process divides the study into another number of shards.

    Its shards would share lanes with those of ``count``.
    """
    for path in directory.glob(".lock-*-of-*"):
        other = path.name.rpartition("-")[2]
        # Shared, so that shards which look at the same moment do not take each other for a holder.
        if other.isdigit() and int(other) != count and _is_locked(path, shared=True):
            raise UserError(
                f"--out {directory}: another process divides the study into {other} shards; wait "
                f"for it, or use --shard i/{other}"
            )


@contextlib.contextmanager
def deriver(directory: Path, wait: bool = True) -> Iterator[None]:
    """Hold the lock of the tables, which all shards share.

    Raises:
        BlockingIOError: when another process holds the lock, and ``wait`` is false.
    """
    with contextlib.ExitStack() as stack:
        handle = _open(directory, directory / ".lock-tables")
        stack.callback(os.close, handle)
        lock(handle, wait=wait)
        yield


def is_held(directory: Path) -> bool:
    """Whether a process is writing to the directory now."""
    return _is_locked(directory / ".lock", shared=False)  # shards hold it shared


def _is_locked(path: Path, *, shared: bool) -> bool:
    """Whether a process holds the lock; with ``shared``, whether it holds it exclusively."""
    try:
        handle = open_for_locking(path, create=False)
    except OSError:
        return False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the warning of a file system without locks
            lock(handle, shared=shared)
    except BlockingIOError:
        return True
    except OSError as error:
        if error.errno != errno.EBADF:
            raise
        return False  # a directory on NFS that this user may only read: nobody can tell
    else:
        return False
    finally:
        os.close(handle)


def _hold(
    stack: contextlib.ExitStack, directory: Path, path: Path, shared: bool, reason: str
) -> int:
    handle = _open(directory, path)
    stack.callback(os.close, handle)
    for patience in (0.1, 0.2, None):  # --status holds a lock for a moment to test it
        try:
            lock(handle, shared=shared)
            break
        except BlockingIOError as error:
            if patience is None:
                raise UserError(
                    f"--out {directory}: {reason}; wait for it, or use --shard i/n"
                ) from error
            time.sleep(patience)
    return handle


def _open(directory: Path, path: Path) -> int:
    try:
        return open_for_locking(path)
    except OSError as error:
        raise UserError(f"--out {directory} cannot be written: {error.strerror}") from error
