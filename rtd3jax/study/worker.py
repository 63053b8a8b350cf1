"""A process that trains lanes for `rtd3jax.study.processes`: ``python -P worker.py``.

The process reads its settings from standard input, and then orders, each a JSON line with the lanes
to train; it writes JSON lines about their progress to standard output. The end of its input, which
also comes if the process at the other end is killed, tells it to write checkpoints and to end.

JAX's runtime takes the cores that a process may use when JAX is imported. So this file is run by
its path, in its own process, and imports the package after it has chosen its cores.
"""

import json
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable
from typing import IO, Any

Answer = Callable[[dict[str, Any]], None]


def main() -> int:
    """Train the lanes that are ordered, and return the exit status."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C: the other end closes the input
    output = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever else is printed must not come between the answers

    def answer(message: dict[str, Any]) -> None:
        output.write(json.dumps(message) + "\n")
        output.flush()

    try:
        with output:
            return _work(answer)
    except BrokenPipeError:
        return 0  # the other end was killed; the lanes have written their checkpoints


def _work(answer: Answer) -> int:
    line = sys.stdin.readline()
    if not line:
        return 0
    settings = json.loads(line)
    if settings["cores"]:
        os.sched_setaffinity(0, settings["cores"])
    from rtd3jax.errors import UserError

    try:
        _serve(settings, sys.stdin, answer)
    except BrokenPipeError:
        raise
    except UserError as error:
        answer({"error": str(error)})
    except OSError as error:  # a full disk, for example
        answer({"error": f"{error.filename or settings['path']}: {error.strerror or error}"})
    return 0


def _serve(settings: dict[str, Any], orders_from: IO[str], answer: Answer) -> None:
    from rtd3jax.study.cells import cell_jobs
    from rtd3jax.study.execute import Work, train_here
    from rtd3jax.study.log import LOG, LoggedReturns
    from rtd3jax.study.rundir import RunDirectory
    from rtd3jax.system.imports import import_modules
    from rtd3jax.training.groups import Group
    from rtd3jax.training.jobs import Job

    import_modules(settings["imports"])
    directory = RunDirectory.open(settings["path"])
    places = {cell: place for place, cell in enumerate(directory.cells)}
    work = Work(**settings["work"])
    logged = LoggedReturns(directory.path / LOG)
    orders = _Orders(orders_from)
    known: dict[int, dict[int, Job]] = {}

    def job(place: int, seed: int) -> Job:
        if place not in known:
            jobs = cell_jobs([directory.cells[place]], directory.seeds, work.strategy)
            known[place] = {job.seed: job for job in jobs}
        return known[place][seed]

    def watch(group: Group) -> None:
        (trained,) = group.jobs
        if group.returns is not None:
            lane = [places[trained.cell], trained.seed]
            told = {"lane": lane, "step": group.step, "began_at": group.began_at}
            answer({**told, "returns": group.returns[0].tolist()})
        if orders.stopped.is_set():
            raise KeyboardInterrupt

    answer({"ready": True})
    while (order := orders.next()) is not None:
        complaints: list[str] = []
        jobs = [job(place, seed) for place, seed in order["lanes"]]
        try:
            train_here(directory, jobs, work, complaints, watch=watch, logged=logged)
        except KeyboardInterrupt:
            break
        answer({"ended": complaints})


class _Orders:
    """The orders of the other end, which a thread reads."""

    def __init__(self, source: IO[str]) -> None:
        self.stopped = threading.Event()
        """Set at the end of the input, and at SIGTERM, which batch systems send to each process."""
        self._waiting: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        signal.signal(signal.SIGTERM, self._stop)
        threading.Thread(target=self._read, args=(source,), daemon=True).start()

    def next(self) -> dict[str, Any] | None:
        """The next order, for which this call waits; None at the end."""
        order = self._waiting.get()
        return None if self.stopped.is_set() else order

    def _read(self, source: IO[str]) -> None:
        for line in source:
            self._waiting.put(json.loads(line))
        self._stop()

    def _stop(self, *_: object) -> None:
        self.stopped.set()
        self._waiting.put(None)


if __name__ == "__main__":
    sys.exit(main())
