"""Interrupts while work is being saved: the first one waits, the second one ends the process."""

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def patient(message: str) -> Iterator[None]:
    """While it is open, the first interrupt only prints ``message``; the next one is handled.

    A person who sees nothing happen after Ctrl-C presses it again, and must not lose what is being
    written. Only the main thread handles signals: in others, this has no effect. Signals that the
    process ignores stay ignored.
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
