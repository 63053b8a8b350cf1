"""Interrupts: SIGTERM as Ctrl-C; and while work is being saved, the first one waits."""

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Terminated(KeyboardInterrupt):
    """Raised at SIGTERM, so that lanes write their checkpoints as they do after Ctrl-C."""


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """A context in which SIGTERM, which a batch system sends before SIGKILL, raises `Terminated`.

    It has no effect in other threads than the main one, and if the program has its own handler.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return

    def terminate(*_: object) -> None:
        raise Terminated

    signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextlib.contextmanager
def patient(message: str) -> Iterator[None]:
    """A context in which the first interrupt only prints ``message``; the next one is handled.

    A user who sees no effect of Ctrl-C presses it again. The message explains the wait, so that the
    user does not lose the files that are being written. Only the main thread handles signals: in
    other threads, the context has no effect. Signals that the process ignores stay ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers: dict[int, Any] = {
        number: handler for number in SIGNALS if callable(handler := signal.getsignal(number))
    }

    def first(number: int, frame: object) -> None:
        restore()
        print(message, file=sys.stderr, flush=True)

    def restore() -> None:
        for number, handler in handlers.items():
            signal.signal(number, handler)

    for number in handlers:
        signal.signal(number, first)
    try:
        yield
    finally:
        restore()
