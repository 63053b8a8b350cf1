"""Tests that an interrupt does not end what is being saved."""

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
