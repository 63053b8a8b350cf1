"""File locks of the operating system: flock, or byte ranges on Windows.

A lock is released when its process ends for any reason. On a file system without locks (Lustre
without flock, NFS without a lock daemon), nothing is locked, and a warning says so.
"""

import errno
import os
import time
import warnings
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
try:
    import msvcrt as _msvcrt
except ImportError:
    _msvcrt = None  # type: ignore[assignment]

msvcrt: Any = _msvcrt
# On macOS, ENOTSUP and EOPNOTSUPP are two numbers; on Linux they are one.
NO_LOCKS = tuple({errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP})
_SHARERS = 1024
"""On Windows, number of bytes: a shared lock locks one of them, an exclusive lock all."""


def lock(handle: int, *, shared: bool = False, wait: bool = False) -> None:
    """Lock an open file until it is closed.

    Raises:
        BlockingIOError: when another process holds the lock and ``wait`` is false.
    """
    try:
        if fcntl is not None:
            kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
            fcntl.flock(handle, kind if wait else kind | fcntl.LOCK_NB)
        elif msvcrt is not None:
            _lock_bytes(handle, shared, wait)
        else:
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        warnings.warn(
            f"this file system has no locks ({error.strerror}): nothing prevents a second process "
            "from writing to the same run directory; start only one, or use --shard i/n",
            stacklevel=2,
        )


def open_for_locking(path: Path, *, create: bool = True) -> int:
    """Open the file for `lock`; `os.close` releases its locks. It must not be a symbolic link.

    Without ``create``, the file must exist; it is opened for reading if it cannot be written.

    Raises:
        OSError: when the file cannot be opened.
    """
    flags = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0)
    if create:
        return os.open(path, flags | os.O_CREAT, 0o666)
    try:  # NFS only locks files that are open for writing
        return os.open(path, flags)
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise
        return os.open(path, flags & ~os.O_RDWR | os.O_RDONLY)


def _lock_bytes(handle: int, shared: bool, wait: bool) -> None:
    """As `lock`, with exclusive locks of byte ranges on Windows."""
    while True:
        for start in range(_SHARERS) if shared else (0,):
            os.lseek(handle, start, os.SEEK_SET)
            try:
                msvcrt.locking(handle, msvcrt.LK_NBLCK, 1 if shared else _SHARERS)
                return
            except OSError as error:
                if error.errno not in (errno.EACCES, errno.EDEADLK):
                    raise
        if not wait:
            raise BlockingIOError(errno.EAGAIN, "another process holds the lock")
        time.sleep(0.05)
