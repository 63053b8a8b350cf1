"""Tests that an interrupt does not end what is being saved."""

import io
import os
import signal
import threading

import pytest

from rtd3jax.system.interrupts import patient


def test_the_first_interrupt_waits_and_the_second_one_does_not(capsys):
    before = signal.getsignal(signal.SIGINT)
    with patient("saving"):
        signal.raise_signal(signal.SIGINT)
        assert capsys.readouterr().err == "saving\n"
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
    with patient("saving"):
        pass
    assert signal.getsignal(signal.SIGINT) is before and capsys.readouterr().err == ""


def test_signals_that_are_ignored_stay_ignored(monkeypatch):
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with patient("saving"):
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_other_threads_leave_signals_alone():
    found = []

    def save():
        with patient("saving"):
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=save)
    thread.start()
    thread.join()
    assert found == [signal.getsignal(signal.SIGINT)]


def test_commands_end_in_one_line_after_an_interrupt_or_a_closed_pipe(capsys, monkeypatch):
    from rtd3jax.cli import common

    def interrupt():
        raise KeyboardInterrupt

    assert common.exit_status(interrupt, lambda: "run") == 130
    assert capsys.readouterr().err == "interrupted: repeat the command\n"

    def broken():
        raise BrokenPipeError(32, "Broken pipe")

    redirected = []
    monkeypatch.setattr(common.os, "dup2", lambda *handles: redirected.append(handles))
    monkeypatch.setattr(common.sys, "stdout", io.TextIOWrapper(io.FileIO(os.dup(1), "w")))
    assert common.exit_status(broken, lambda: "run") == 0
    assert redirected and capsys.readouterr().err == ""

    class Closed(io.StringIO):  # what is in its buffer cannot be written
        def flush(self):
            raise BrokenPipeError(32, "Broken pipe")

        def fileno(self):
            return 1

    redirected.clear()
    monkeypatch.setattr(common.sys, "stdout", Closed())
    assert common.exit_status(lambda: 7, lambda: "run") == 7 and redirected


def test_the_last_line_of_a_traceback_says_most():
    from rtd3jax.errors import short_reason

    callback = RuntimeError(
        "INTERNAL: callback: Traceback (most recent call last):\n  File x\nOSError: no licence\n"
    )
    assert short_reason(callback) == "OSError: no licence"
    assert short_reason(ValueError("first\nsecond")) == "first"
    assert short_reason(ValueError()) == "ValueError"
