"""Measures the speed of training: compared with PyTorch, with matrix products, and by agent.

Usage: python -m experiments.benchmarks.bench [--quick] [--agents A ...] [--lengths L ...]
                                              [--repeats N] [--seconds S] [--out DIR] [--fresh]

For every agent and window length, five seeds (batch 100, width 128) train on the rover under AR(1)
slip with all cores: environment step, replay and all updates. rtd3jax, PyTorch with two ways to use
the cores, and large matrix products are measured alternately, A B C A B C; each ratio is computed
from measurements that follow each other. Then a replay of a million rows is compared with one of
ten thousand, eight lanes with two, and compilation with and without JAX's persistent cache.

The script writes measurements.csv after every agent and length, then bench.md and bench.png, to
--out. If you repeat the command, it only measures what is missing.
"""

import argparse
import dataclasses
import functools
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pandas as pd

import rtd3jax as rtd
from experiments.benchmarks import report
from experiments.benchmarks.ours import Lanes, make_config, sgemm
from experiments.benchmarks.torch_processes import (
    ONE_PROCESS,
    PROCESS_PER_CORE,
    ROOT,
    TorchProcesses,
    is_installed,
)
from experiments.writing import parse
from rtd3jax.envs.interface import foreign_code
from rtd3jax.errors import UserError
from rtd3jax.system.files import write_bytes_atomically
from rtd3jax.training.devices import workers

LENGTHS = (1, 3, 6, 10, 20)
SEEDS = 5
PRECISIONS = ("float32", "bfloat16")


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of the measurements, which ``--quick`` reduces."""

    hidden_size: int = 128
    batch_size: int = 100
    replay_capacity: int = 30_000
    product: int = 2048
    """rows and columns of the large matrices"""
    large_replay: int = 1_000_000
    small_replay: int = 10_000
    many_lanes: int = 8
    few_lanes: int = 2
    lanes_length: int = 10
    """window length of the lanes that are compared"""


# One replay size and one length, so that one program is compiled.
QUICK = Sizes(8, 10, 211, 64, 211, 211, lanes_length=1)


class Measurements:
    """The measurements so far, which every `add` writes to disk.

    Columns: ``agent``, ``history_length``, ``measurement``, ``repeat``, ``value`` and ``machine``.
    """

    def __init__(self, path: pathlib.Path, fresh: bool, machine: str):
        self._path, self._machine = path, machine
        if fresh and path.exists():
            _put_aside(path)
        self.table = pd.read_csv(path) if path.exists() else pd.DataFrame(columns=report.COLUMNS)
        others = set(self.table["machine"]) - {machine}
        if others:
            raise UserError(
                f"{path} was measured on another machine ({others.pop()}); use --fresh, which "
                "renames it, or another --out"
            )

    def has(self, agent: str, length: int, counts: dict[str, int]) -> bool:
        """Whether this cell has the numbers of measurements that ``counts`` requires."""
        found = report.cell(self.table, agent, length).groupby("measurement").size()
        return all(found.get(name, 0) >= count for name, count in counts.items())

    def add(self, agent: str, length: int, values: list[tuple[str, int, float]]) -> None:
        """Replace the rows of the cell."""
        names = {name for name, _, _ in values}
        kept = self.table
        old = (kept["agent"] == agent) & (kept["history_length"] == length)
        kept = kept[~(old & kept["measurement"].isin(names))]
        rows = [(agent, length, *value, self._machine) for value in values]
        new = pd.DataFrame(rows, columns=report.COLUMNS)
        self.table = pd.concat([kept, new], ignore_index=True) if len(kept) else new
        write_bytes_atomically(self._path, self.table.to_csv(index=False).encode())


class Bench:
    """The measurements, and the programs that take them."""

    def __init__(self, options: argparse.Namespace, torch: TorchProcesses | None):
        self.sizes = QUICK if options.quick else Sizes()
        self.repeats, self.seconds = options.repeats, options.seconds
        self.torch = torch
        known = {field.name for field in dataclasses.fields(rtd.Config)}
        self.precisions = PRECISIONS if "precision" in known else PRECISIONS[:1]
        if options.quick:
            self.precisions = self.precisions[:1]

    @property
    def counts(self) -> dict[str, int]:
        """Number of repeats of each measurement of a cell; compilation is measured once."""
        names = [report.ours(precision) for precision in self.precisions]
        names += [report.SGEMM, report.SGEMM_NUMPY]
        if self.torch is not None:
            names += [ONE_PROCESS, PROCESS_PER_CORE, report.SGEMM_TORCH]
        return {
            **dict.fromkeys(names, self.repeats),
            **{report.compiling(precision): 1 for precision in self.precisions},
        }

    def config(self, agent: str, length: int, precision: str = "float32", **changes) -> rtd.Config:
        """The configuration of an agent with the sizes of the benchmark."""
        settings: dict[str, Any] = {
            "hidden_size": self.sizes.hidden_size,
            "batch_size": self.sizes.batch_size,
            "replay_capacity": self.sizes.replay_capacity,
        }
        if precision != "float32":
            settings["precision"] = precision
        return make_config(agent, length, **{**settings, **changes})

    def cell(self, agent: str, length: int) -> Iterator[tuple[str, int, float]]:
        """Yield all measurements of an agent and a length: name, repeat, value."""
        sides: dict[str, Callable[[], float]] = {}
        for precision in self.precisions:
            lanes = Lanes(self.config(agent, length, precision), SEEDS)
            yield report.compiling(precision), 0, lanes.warm_up(self.seconds / 3)
            sides[report.ours(precision)] = _rate(lanes, self.seconds)
        if self.torch is not None:
            sides |= self._torch_sides(self.torch, agent, length)
        sides |= self._sgemm_sides()
        yield from self._interleaved(sides)

    def replay_sizes(self) -> Iterator[tuple[str, int, float]]:
        """Compare a full large replay with a full small one, at length 1 with its short steps."""
        sides = {}
        for name, capacity in (
            (report.LARGE_REPLAY, self.sizes.large_replay),
            (report.SMALL_REPLAY, self.sizes.small_replay),
        ):
            config = self.config(report.ONE_STREAM, 1, replay_capacity=capacity)
            lanes = Lanes(config, len(workers()))
            lanes.fill_replay(self.sizes.large_replay)
            lanes.warm_up(self.seconds / 3)
            sides[name] = _rate(lanes, self.seconds)
        return self._interleaved(sides)

    def lane_counts(self) -> Iterator[tuple[str, int, float]]:
        """Compare many lanes with few lanes."""
        sides = {}
        for name, count in (
            (report.MANY_LANES, self.sizes.many_lanes),
            (report.FEW_LANES, self.sizes.few_lanes),
        ):
            lanes = Lanes(self.config(report.ONE_STREAM, self.sizes.lanes_length), count)
            lanes.warm_up(self.seconds / 3)
            sides[name] = _rate(lanes, self.seconds)
        return self._interleaved(sides)

    def _torch_sides(self, torch, agent, length) -> dict[str, Callable[[], float]]:
        torch.prepare(
            agent=agent,
            history_length=0 if agent == "td3" else length,
            width=self.sizes.hidden_size,
            batch=self.sizes.batch_size,
            capacity=self.sizes.replay_capacity,
            learning_starts=self.sizes.batch_size,
            warm_up=4,
        )
        return {
            way: lambda way=way: torch.run(way, self.seconds)
            for way in (ONE_PROCESS, PROCESS_PER_CORE)
        }

    def _sgemm_sides(self) -> dict[str, Callable[[], float]]:
        size, seconds = self.sizes.product, self.seconds / 3
        sides: dict[str, Callable[[], float]] = {
            report.SGEMM: lambda: _quotient(sgemm(size, seconds)),
            report.SGEMM_NUMPY: lambda: _quotient(_numpy_sgemm(size, seconds)),
        }
        if self.torch is not None:
            torch = self.torch
            sides[report.SGEMM_TORCH] = lambda: torch.sgemm(PROCESS_PER_CORE, size, seconds)
        return sides

    def _interleaved(self, sides: dict[str, Callable[[], float]]) -> Iterator:
        for repeat in range(self.repeats):
            for name, measure in sides.items():
                yield name, repeat, measure()


def compile_times(agent: str, length: int, repeats: int) -> Iterator[tuple[str, int, float]]:
    """Compilation of a program in a new process, without and with JAX's persistent cache."""
    with tempfile.TemporaryDirectory() as cache:
        _compile_in_new_process(agent, length, cache)
        for repeat in range(repeats):
            yield report.COLD, repeat, _compile_in_new_process(agent, length, None)
            yield report.CACHED, repeat, _compile_in_new_process(agent, length, cache)


def _compile_in_new_process(agent: str, length: int, cache: str | None) -> float:
    environment = dict(os.environ)
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    if cache is not None:
        environment["JAX_COMPILATION_CACHE_DIR"] = cache
        environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    program = (
        "from experiments.benchmarks.ours import Lanes, make_config\n"
        "import jax\n"
        "jax.devices()\n"  # starting the backend is not compiling
        f"print(Lanes(make_config({agent!r}, {length}), 1).compile())"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, cwd=ROOT, capture_output=True, text=True
    )
    if result.returncode:
        raise RuntimeError(f"compiling in a new process failed: {result.stderr[-1000:]}")
    return float(result.stdout)


def _rate(lanes: Lanes, seconds: float) -> Callable[[], float]:
    return lambda: _quotient(lanes.run(seconds))


def _quotient(done: tuple[float, float]) -> float:
    return done[0] / done[1]


def _numpy_sgemm(size: int, seconds: float) -> tuple[float, float]:
    """Operations and seconds of large products by numpy's BLAS, with its own threads."""
    a = np.random.default_rng(0).standard_normal((size, size), np.float32)
    out = np.empty_like(a)
    np.matmul(a, a, out=out)
    products, began = 0, time.perf_counter()
    while time.perf_counter() - began < seconds or not products:
        np.matmul(a, a, out=out)
        products += 1
    return products * 2.0 * size**3, time.perf_counter() - began


def machine() -> str:
    """Processor and cores, which identify the machine of a result.

    The processor's family and model are included, because the name in a virtual machine hides them.
    """
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    # The entries of the first processor; the others are equal.
    facts = {
        name.strip(): value.strip() for name, _, value in (x.partition(":") for x in lines[::-1])
    }
    name = facts.get("model name", "unknown processor")
    if "cpu family" in facts and "model" in facts:
        name += f" (family {facts['cpu family']}, model {facts['model']})"
    return f"{name}, {len(workers())} cores"


def _put_aside(path: pathlib.Path) -> None:
    number = 1
    while (aside := path.with_name(f"{path.name}.old-{number}")).exists():
        number += 1
    path.rename(aside)


def cells(agents: list[str], lengths: list[int]) -> list[tuple[str, int]]:
    """Agent and length of all cells; td3 has no window, and so only one cell."""
    pairs = [(a, 0 if a == "td3" else length) for a in agents for length in lengths]
    return list(dict.fromkeys(pairs))


def measure(options: argparse.Namespace, torch: TorchProcesses | None) -> pd.DataFrame:
    """Take the missing measurements; return all measurements."""
    bench = Bench(options, torch)
    done = Measurements(options.out / "measurements.csv", options.fresh, machine())
    todo = [
        pair for pair in cells(options.agents, options.lengths) if not done.has(*pair, bench.counts)
    ]
    for number, (agent, length) in enumerate(todo, 1):
        began = time.perf_counter()
        done.add(agent, length, list(bench.cell(agent, length)))
        seconds = time.perf_counter() - began
        print(f"{number}/{len(todo)} {agent} l={length}: {seconds:.0f} s", flush=True)
    if report.ONE_STREAM in options.agents:
        _measure_extras(bench, done, with_compiling=not options.quick)
    return done.table


def _measure_extras(bench: Bench, done: Measurements, with_compiling: bool) -> None:
    """Replay sizes, numbers of lanes and compile times, of the one-stream agent."""
    agent, count, lanes = report.ONE_STREAM, bench.repeats, bench.sizes.lanes_length
    extras: list[tuple[str, int, tuple[str, str], Callable[[], Iterator]]] = [
        ("replay sizes", 1, (report.LARGE_REPLAY, report.SMALL_REPLAY), bench.replay_sizes),
        ("numbers of lanes", lanes, (report.MANY_LANES, report.FEW_LANES), bench.lane_counts),
    ]
    if with_compiling:
        compiling = functools.partial(compile_times, agent, 10, count)
        extras.append(("compile times", 10, (report.COLD, report.CACHED), compiling))
    for title, length, names, measure in extras:
        if not done.has(agent, length, dict.fromkeys(names, count)):
            done.add(agent, length, list(measure()))
            print(f"{title}: measured", flush=True)


def read_options(arguments: list[str] | None) -> argparse.Namespace:
    """The options, after the changes of ``--quick``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--agents", nargs="+", choices=rtd.ALGORITHMS, metavar="AGENT")
    parser.add_argument("--lengths", nargs="+", type=int, metavar="L")
    parser.add_argument("--repeats", type=int, help="rounds of each comparison [3]")
    parser.add_argument("--seconds", type=float, help="duration of each measurement [1.8]")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("runs/bench"))
    parser.add_argument("--fresh", action="store_true", help="rename earlier measurements")
    parser.add_argument("--no-torch", action="store_true", help="leave PyTorch out")
    options = parse(parser, arguments)
    quick = options.quick
    options.agents = options.agents or ([report.ONE_STREAM] if quick else list(rtd.ALGORITHMS))
    options.lengths = options.lengths or ([1] if quick else list(LENGTHS))
    options.repeats = options.repeats or (2 if quick else 3)
    options.seconds = options.seconds or (0.05 if quick else 1.8)
    if min(options.lengths) < 1 or options.repeats < 1 or options.seconds <= 0:
        parser.error("--lengths, --repeats and --seconds must be positive")
    return options


def main(arguments: list[str] | None = None) -> int:
    options = read_options(arguments)
    with_torch = is_installed() and not options.no_torch
    if not with_torch:
        why = "--no-torch" if options.no_torch else "it is not installed: pip install '.[bench]'"
        print(f"PyTorch and its columns are left out ({why})", flush=True)
    try:
        if with_torch:
            with TorchProcesses(len(workers()), SEEDS) as torch:
                table = measure(options, torch)
        else:
            table = measure(options, None)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    sizes = QUICK if options.quick else Sizes()
    text = report.markdown(table, sizes.hidden_size, sizes.batch_size)
    write_bytes_atomically(options.out / "bench.md", text.encode())
    with foreign_code():
        report.picture(table, options.out / "bench.png", sizes.hidden_size, sizes.batch_size)
    print(f"\n{text}\nwritten to {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
