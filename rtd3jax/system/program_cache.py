"""Room for compiled programs: a process may map only so many pieces of memory.

XLA's CPU backend maps the code of every kernel by itself: a training program is some 1,700
mappings, an evaluation a few hundred. Linux allows a process 65,530 (``vm.max_map_count``); past
that, compiling fails and the process dies. A study has more programs than that, so programs are let
go in time; whoever needs one again compiles it again, or reads it from JAX's persistent cache.
"""

import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path

import jax

_MAPS, _LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_SHARE = 0.6
"""Of the mappings that are allowed: what is compiled until the next look must fit in the rest."""
_SECONDS = 2.0
"""Between two looks: counting takes milliseconds, compiling one program seconds."""

_caches: list[Callable[[], None]] = []
_lock = threading.Lock()
_looked = -_SECONDS


def on_full(empty: Callable[[], None]) -> Callable[[], None]:
    """Register what lets go of a cache of programs; a decorator."""
    _caches.append(empty)
    return empty


def make_room() -> bool:
    """Let all programs go if the process has most of its mappings; whether that was so.

    To be called where programs are about to be compiled; cheap. Programs that are running are not
    harmed. Does nothing where there is no such limit to be read.
    """
    global _looked
    with _lock:
        if time.monotonic() - _looked < _SECONDS:
            return False
        _looked = time.monotonic()
        used, limit = _mappings()
        if used <= _SHARE * limit:
            return False
        for empty in _caches:
            empty()
        jax.clear_caches()
        return True


def _mappings() -> tuple[int, float]:
    """How many the process has, and how many it may have."""
    with contextlib.suppress(OSError, ValueError):
        limit = int(_LIMIT.read_text("utf-8"))
        with _MAPS.open("rb") as lines:
            return sum(1 for _ in lines), float(limit)
    return 0, float("inf")
