"""Compares the speed of two checkouts: whole training steps, and compilation.

Usage: python experiments/reliability/same_speed.py OTHER [--quick] [--agents A ...]
                                                    [--lengths L ...] [--rounds N] [--seconds S]

OTHER is the directory of another checkout, for example of `git worktree add /tmp/other COMMIT`.
Each checkout has its own process, with the lanes of the benchmark: one for each core, width 128,
batch 100, on the rover. They are measured alternately, and each ratio is computed from measurements
that follow each other. The table has the median and the quartiles of the time here divided by the
time there. The compilation is measured once, without JAX's persistent cache.
"""

import argparse
import os
import pathlib
import subprocess
import sys

import numpy as np

HERE = pathlib.Path(__file__).parents[2]

WORKER = """
import sys
import jax
from experiments.benchmarks.ours import Lanes, make_config
agent, length, size, seconds = sys.argv[1], *map(int, sys.argv[2:4]), float(sys.argv[4])
jax.devices()
lanes = Lanes(make_config(agent, length, hidden_size=size, batch_size=min(100, 10 * size)), 2)
print(lanes.warm_up(seconds), flush=True)
for _ in sys.stdin:
    steps, taken = lanes.run(seconds)
    print(taken / steps, flush=True)
"""


class Worker:
    """The process of a checkout, which is idle between measurements."""

    def __init__(self, checkout: pathlib.Path, arguments: list[str]):
        environment = {**os.environ, "PYTHONPATH": str(checkout)}
        environment["JAX_ENABLE_COMPILATION_CACHE"] = "false"
        self._process = subprocess.Popen(
            [sys.executable, "-c", WORKER, *arguments],
            cwd=checkout,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.compiling = self._answer()

    def step(self) -> float:
        """Measure the seconds of a step."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return self._answer()

    def end(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def _answer(self) -> float:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit("the process of a checkout ended; see its error above")
        return float(line)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", type=pathlib.Path)
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--agents", nargs="+", default=["lstm-td3-1ha1hc", "td3", "h-td3"])
    parser.add_argument("--lengths", nargs="+", type=int, default=[1, 20])
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--seconds", type=float, default=1.5)
    options = parser.parse_args(arguments)
    size = 128
    if options.quick:
        options.agents, options.lengths, options.rounds, options.seconds = ["td3"], [1], 2, 0.05
        size = 8
    print("| agent | l | a step: here / there | quartiles | compiling: here / there |")
    print("|---|---|---|---|---|")
    for agent in options.agents:
        for length in options.lengths if agent != "td3" else [0]:
            asked = [agent, str(length), str(size), str(options.seconds)]
            checkouts = options.other.resolve(), HERE
            workers = [Worker(checkout, asked) for checkout in checkouts]
            ratios = []
            for _ in range(options.rounds):
                there, here = (worker.step() for worker in workers)
                ratios.append(here / there)
            for worker in workers:
                worker.end()
            low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75])
            compiling = workers[1].compiling / workers[0].compiling
            step = f"{middle:.3f} | {low:.3f} to {high:.3f}"
            print(f"| {agent} | {length} | {step} | {compiling:.2f} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
