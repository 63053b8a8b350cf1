"""Compares a process per core with the threads of one process.

Usage: python -m experiments.benchmarks.process_per_core [--quick] [--agent A] [--lengths L ...]
                                                         [--rounds N] [--seconds S] [--out DIR]

There is a lane for each core (width 128, batch 100, rover): in one process, as in the sweep, and in
a process for each core, pinned to it. The two ways are measured alternately, and each ratio is
computed from measurements that follow each other. The script writes process_per_core.md, .parquet
and .json.
"""

import argparse
import os
import pathlib
import subprocess
import sys

import numpy as np
import pandas as pd

from experiments.benchmarks.bench import machine
from rtd3jax.system.machine import cores

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
from writing import BENCHMARKS, markdown_table, parse, provenance, write_results  # noqa: E402

ROOT = pathlib.Path(__file__).parents[2]
WORKER = """
import os, sys
agent, length, size, seconds, lanes, core = *sys.argv[1:2], *map(float, sys.argv[2:])
if core >= 0:
    os.sched_setaffinity(0, {int(core)})
from experiments.benchmarks.ours import Lanes, make_config
sizes = dict(hidden_size=int(size), batch_size=min(100, 10 * int(size)))
lanes = Lanes(make_config(agent, int(length), **sizes), int(lanes))
lanes.warm_up(seconds)
print("ready", flush=True)
for _ in sys.stdin:
    steps, taken = lanes.run(seconds)
    print(steps / taken, flush=True)
"""


class Processes:
    """Processes that train together during a measurement, and are idle otherwise."""

    def __init__(self, asked: list[str], shares: list[tuple[int, int]]):
        self._processes = [
            subprocess.Popen(
                [sys.executable, "-c", WORKER, *asked, str(lanes), str(core)],
                cwd=ROOT,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for lanes, core in shares
        ]
        self._answers()

    def rate(self) -> float:
        """Lane-steps per second of all processes together."""
        for process in self._processes:
            assert process.stdin is not None
            process.stdin.write("\n")
            process.stdin.flush()
        return sum(map(float, self._answers()))

    def end(self) -> None:
        """End the processes."""
        for process in self._processes:
            assert process.stdin is not None
            process.stdin.close()
            process.wait()

    def _answers(self) -> list[str]:
        lines = [process.stdout.readline() for process in self._processes if process.stdout]
        if not all(lines):
            raise SystemExit("a process ended; see its error above")
        return lines


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--agent", default="lstm-td3-1ha1hc")
    parser.add_argument("--lengths", nargs="+", type=int, default=[1, 20])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--out", type=pathlib.Path, default=BENCHMARKS)
    options = parse(parser, arguments)
    size = 128
    if options.quick:
        options.lengths, options.rounds, options.seconds, size = [1], 2, 0.05, 8
    own = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else range(cores())
    rows = []
    for length in options.lengths:
        asked = [options.agent, str(length), str(size), str(options.seconds)]
        ways = {
            "threads": Processes(asked, [(len(own), -1)]),
            "processes": Processes(asked, [(1, core) for core in own]),
        }
        for number in range(options.rounds):
            rows.append((length, number, *(way.rate() for way in ways.values())))
        for way in ways.values():
            way.end()
    table = pd.DataFrame(rows, columns=["history_length", "round", "threads", "processes"])
    body = []
    for length, here in table.groupby("history_length"):
        low, middle, high = np.quantile(here["processes"] / here["threads"], [0.25, 0.5, 0.75])
        rates = (f"{here[way].median():.0f}" for way in ("threads", "processes"))
        body.append([str(length), *rates, f"{middle:.3f}", f"{low:.3f} to {high:.3f}"])
    header = ["l", "steps/s, threads", "steps/s, processes", "processes over threads", "quartiles"]
    text = markdown_table(header, body)
    facts = provenance(agent=options.agent, rounds=options.rounds, machine=machine())
    write_results(options.out, "process_per_core", table, text, facts)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
