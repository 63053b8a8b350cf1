"""Removes compiled programs from memory before the process reaches its limit of memory mappings.

XLA's CPU backend makes a memory mapping for every kernel: a training program needs about 1,700
mappings, an evaluation a few hundred. Linux allows a process 65,530 mappings
(``vm.max_map_count``); beyond this limit compilation fails and the process dies. A large study
needs more, so its programs are removed in time. A program that is needed again is compiled again,
or read from JAX's persistent cache.
"""

import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path

import jax

_MAPS, _LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_SHARE = 0.6
"""Share of the allowed mappings at which programs are removed.

Programs that are compiled before the next count must fit in the rest.
"""
_SECONDS = 2.0
"""Seconds between two counts: a count takes milliseconds, the compilation of a program seconds."""

_caches: list[Callable[[], None]] = []
_lock = threading.Lock()
_counted_at = -_SECONDS


def on_full(empty: Callable[[], None]) -> Callable[[], None]:
    """Register a function that empties a cache of programs; a decorator."""
    _caches.append(empty)
    return empty


def make_room() -> bool:
    """Remove all programs if the process is near its limit of mappings.

    Call it before programs are compiled; it costs little. Programs that are running go on. On a
    system without this limit nothing happens.

    Returns:
        whether the programs were removed.
    """
    global _counted_at
    with _lock:
        if time.monotonic() - _counted_at < _SECONDS:
            return False
        _counted_at = time.monotonic()
        used, limit = _mappings()
        if used <= _SHARE * limit:
            return False
        forget_programs()
        return True


def forget_programs() -> None:
    """Remove all programs, also if there is room."""
    for empty in _caches:
        empty()
    jax.clear_caches()


def _mappings() -> tuple[int, float]:
    """How many mappings the process has, and how many it may have."""
    with contextlib.suppress(OSError, ValueError):
        limit = int(_LIMIT.read_text("utf-8"))
        with _MAPS.open("rb") as lines:
            return sum(1 for _ in lines), float(limit)
    return 0, float("inf")
