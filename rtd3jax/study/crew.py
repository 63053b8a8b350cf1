"""The processes that train lanes for `rtd3jax.study.processes`, and messages from them."""

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rtd3jax.errors import UserError
from rtd3jax.study import worker
from rtd3jax.system.interrupts import patient
from rtd3jax.training.groups import Group

_ENDING = (
    "the processes end their current steps and write checkpoints; another interrupt ends them "
    "without these"
)
_PATIENCE_SECONDS = 300.0
"""Seconds that processes have to end a chunk or a compilation, and to write checkpoints."""


class Member:
    """A process of the crew.

    Attributes:
        cores: the cores to which the process is pinned; empty where the system cannot pin.
        lanes: the lanes that it trains now, as groups of one lane.
        executable: `Job.executable` of the lanes that it trained last, which it has compiled.
        ready: whether it has imported the package and opened the study.
    """

    def __init__(
        self,
        cores: Sequence[int],
        settings: dict[str, Any],
        handles: Sequence[int],
        messages: "queue.SimpleQueue[tuple[Member, dict[str, Any] | None]]",
    ) -> None:
        self.cores = cores
        self.lanes: list[Group] = []
        self.executable: object = None
        self.ready = False
        self._messages = messages
        package = str(Path(__file__).parents[2])
        path = os.pathsep.join([package, *filter(None, sys.path)])
        posix: dict[str, Any] = {"pass_fds": handles} if os.name == "posix" else {}
        # -P: the directory of the file must not be on the path, as it holds modules of the package.
        self._process = subprocess.Popen(
            [sys.executable, "-P", worker.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            encoding="utf-8",
            env={**os.environ, "PYTHONPATH": path, "JAX_PLATFORMS": "cpu"},
            **posix,
        )
        self._send({**settings, "cores": list(cores)})
        threading.Thread(target=self._read, daemon=True).start()

    @property
    def pid(self) -> int:
        """The number of the process."""
        return self._process.pid

    def order(self, lanes: Sequence[Group], names: Sequence[tuple[int, int]]) -> None:
        """Let the process train ``lanes``; ``names`` are the cell's index and the seed of each."""
        self.lanes, self.executable = list(lanes), lanes[0].jobs[0].executable
        self._send({"lanes": [list(name) for name in names]})

    def end(self) -> None:
        """Tell the process to write checkpoints and to end."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # the process has ended already
            self._process.stdin.close()

    def wait(self, seconds: float) -> int | None:
        """The exit status, negative for a signal; None if the process goes on after ``seconds``."""
        try:
            return self._process.wait(max(0.0, seconds))
        except subprocess.TimeoutExpired:
            return None

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.wait()

    def _send(self, message: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # the process has ended, and `messages` reports it
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.endswith("\n"):  # else the process was killed while it wrote the line
                self._messages.put((self, json.loads(line)))
        self._messages.put((self, None))


class Crew:
    """A context with a process for each share of the cores; at its end, all processes have ended.

    Args:
        shares: the cores of each process.
        settings: the settings that `rtd3jax.study.worker` reads first, without the cores.
        handles: files that the processes inherit: the locks of the run directory.
    """

    def __init__(
        self, shares: Sequence[Sequence[int]], settings: dict[str, Any], handles: Sequence[int]
    ) -> None:
        self.members: list[Member] = []
        self._shares, self._settings, self._handles = shares, settings, handles
        self._messages: queue.SimpleQueue[tuple[Member, dict[str, Any] | None]]
        self._messages = queue.SimpleQueue()

    def __enter__(self) -> "Crew":
        try:
            for cores in self._shares:
                self.begin(cores)
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def begin(self, cores: Sequence[int]) -> None:
        """Start a process on these cores.

        Raises:
            UserError: when the system refuses.
        """
        try:
            member = Member(cores, self._settings, self._handles, self._messages)
        except OSError as error:
            raise UserError(
                f"--processes: a process cannot be started ({error.strerror}); use --processes 1"
            ) from error
        self.members.append(member)

    def messages(self, seconds: float) -> Iterator[tuple[Member, dict[str, Any] | None]]:
        """Each process with its message; None is the message of a process that has ended.

        The call waits at most ``seconds`` for the first message.
        """
        with contextlib.suppress(queue.Empty):
            yield self._messages.get(timeout=seconds)
            while True:
                yield self._messages.get_nowait()

    def _end(self) -> None:
        """Let the processes write checkpoints; if a user insists, or much later, kill them."""
        try:
            with patient(_ENDING):
                until = time.monotonic() + _PATIENCE_SECONDS
                for member in self.members:
                    member.end()
                for member in self.members:
                    member.wait(until - time.monotonic())
        finally:
            for member in self.members:
                member.kill()
