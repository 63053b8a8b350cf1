"""The processes of the PyTorch reference, and their two ways of using the cores."""

import importlib.util
import json
import os
import pathlib
import subprocess
import sys
from typing import Any

ROOT = pathlib.Path(__file__).parents[2]
ONE_PROCESS, PROCESS_PER_CORE = "torch, one process", "torch, a process per core"


def is_installed() -> bool:
    """Whether PyTorch is installed."""
    return importlib.util.find_spec("torch") is not None


class TorchProcesses:
    """A process with all threads, and a process with one thread for each core; usually idle."""

    def __init__(self, cores: int, seeds: int):
        self._seeds = list(range(seeds))
        self._ways = {
            ONE_PROCESS: [_start(cores)],
            PROCESS_PER_CORE: [_start(1) for _ in range(min(cores, seeds))],
        }

    def __enter__(self) -> "TorchProcesses":
        return self

    def __exit__(self, *_: Any) -> None:
        for process in self._all():
            process.stdin.close()
            process.wait()

    def prepare(self, **settings: Any) -> None:
        """Prepare all seeds in the one process, and a share of them in each of the others."""
        for processes in self._ways.values():
            shares = [self._seeds[rank :: len(processes)] for rank in range(len(processes))]
            _ask(processes, [{"do": "prepare", "seeds": share, **settings} for share in shares])

    def run(self, way: str, seconds: float) -> float:
        """Seed-steps per second of all processes of the way together."""
        return self._rate(way, {"do": "run", "seconds": seconds})

    def sgemm(self, way: str, size: int, seconds: float) -> float:
        """Operations per second of large float32 products."""
        return self._rate(way, {"do": "sgemm", "size": size, "seconds": seconds})

    def _rate(self, way: str, order: dict) -> float:
        processes = self._ways[way]
        answers = _ask(processes, [order] * len(processes))
        return sum(answer["steps"] / answer["seconds"] for answer in answers)

    def _all(self) -> list:
        return [process for processes in self._ways.values() for process in processes]


def _start(threads: int) -> subprocess.Popen:
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}
    return subprocess.Popen(
        [sys.executable, "-m", "experiments.benchmarks.torch_worker", str(threads)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=environment,
    )


def _ask(processes: list, orders: list[dict]) -> list[dict]:
    """Send every process its order, then wait for all answers."""
    for process, order in zip(processes, orders, strict=True):
        process.stdin.write(json.dumps(order) + "\n")
        process.stdin.flush()
    lines = [process.stdout.readline() for process in processes]
    if not all(lines):
        raise RuntimeError("a process of the PyTorch reference ended; see its error above")
    return [json.loads(line) for line in lines]
