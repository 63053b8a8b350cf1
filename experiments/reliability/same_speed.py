"""Compares the speed of two checkouts, or of the loop with and without its metrics of learning.

Usage: python experiments/reliability/same_speed.py OTHER [--quick] [--agents A ...]
                                                    [--lengths L ...] [--rounds N] [--seconds S]
                                                    [--processes N]
       python experiments/reliability/same_speed.py --metrics [...]

OTHER is the directory of another checkout, for example of `git worktree add /tmp/other COMMIT`.
With `--metrics`, the other side is this checkout without the code that collects metrics. Each side
has its own process, with the lanes of the benchmark: one for each core, width 128, batch 100, on
the rover. The sides are measured alternately, and each ratio is computed from measurements that
follow each other. The rounds are divided over several pairs of processes, whose speeds differ by up
to 1% because of the places of their arrays in memory. The table has the median of the time here
divided by the time there, its 95% interval from a bootstrap over the pairs, and the same of the
compilation, which happens without JAX's persistent cache.
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
if sys.argv[5] == "without-metrics":
    from rtd3jax.training import loop
    loop.note_update = loop.note_reward = loop.averaged = lambda averages, *_: averages
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
    parser.add_argument("other", type=pathlib.Path, nargs="?")
    parser.add_argument("--metrics", action="store_true", help="compare with no metrics, here")
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--agents", nargs="+", default=["lstm-td3-1ha1hc", "td3", "h-td3"])
    parser.add_argument("--lengths", nargs="+", type=int, default=[1, 20])
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--seconds", type=float, default=1.5)
    parser.add_argument("--processes", type=int, default=7, help="pairs")
    options = parser.parse_args(arguments)
    if (options.other is None) != options.metrics:
        parser.error("give either another checkout or --metrics")
    size = 128
    if options.quick:
        options.agents, options.lengths, options.rounds, options.seconds = ["td3"], [1], 2, 0.05
        size, options.processes = 8, 2
    checkouts = (options.other or HERE).resolve(), HERE
    kinds = ("without-metrics" if options.metrics else "all", "all")
    print("| agent | l | a step: here / there | 95% interval | compiling | 95% interval |")
    print("|---|---|---|---|---|---|")
    for agent in options.agents:
        for length in options.lengths if agent != "td3" else [0]:
            asked = [agent, str(length), str(size), str(options.seconds)]
            sides = [
                (checkout, [*asked, kind]) for checkout, kind in zip(checkouts, kinds, strict=True)
            ]
            compiling, ratios = [], []
            for _ in range(options.processes):
                workers = [Worker(*side) for side in sides]
                compiling.append([workers[1].compiling / workers[0].compiling])
                ratios.append([])
                for number in range(-(-options.rounds // options.processes)):
                    # In both orders, so that neither side always follows the other.
                    order = workers if number % 2 else workers[::-1]
                    taken = {id(worker): worker.step() for worker in order}
                    ratios[-1].append(taken[id(workers[1])] / taken[id(workers[0])])
                for worker in workers:
                    worker.end()
            columns = [agent, str(length), *_median(ratios), *_median(compiling)]
            print(f"| {' | '.join(columns)} |", flush=True)
    return 0


def _median(ratios: list[list[float]]) -> tuple[str, str]:
    """The median of all ratios, and its 95% interval from a bootstrap over the pairs."""
    table, random = np.array(ratios), np.random.default_rng(0)
    draws = table[random.integers(len(table), size=(4_000, len(table)))]
    low, high = np.quantile(np.median(draws, axis=(1, 2)), [0.025, 0.975])
    return f"{np.median(table):.3f}", f"{low:.3f} to {high:.3f}"


if __name__ == "__main__":
    sys.exit(main())
