"""One writer for a run directory, or one for each shard of it.

The lock is the operating system's (flock): it goes when its process goes, however that ends.
"""

import contextlib
import fcntl
import os
import re
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


def _hold(stack: contextlib.ExitStack, directory: Path, path: Path, kind: int, reason: str) -> None:
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        raise UserError(f"--out {directory} cannot be written: {error.strerror}") from error
    stack.callback(os.close, handle)
    try:
        fcntl.flock(handle, kind | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise UserError(f"--out {directory}: {reason}; wait for it, or use --shard i/n") from error
