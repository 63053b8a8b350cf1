"""Measures the overhead of checkpoints at the default interval.

Usage: python experiments/reliability/overhead.py [--quick]

The script writes the checkpoint of a full-size lane (H = 128, pendulum) several times and takes the
median time. If five seeds of a cell are trained on two cores, each writes a checkpoint per
interval, and its core waits: the overhead is 5 × seconds / (2 × interval), where the interval is
five minutes, or 150 times the time of a checkpoint.
"""

import argparse
import pathlib
import statistics
import tempfile
import time

import jax

import rtd3jax as rtd
from rtd3jax.training.checkpoint import _PATIENCE, DEFAULT_SECONDS, Checkpoints
from rtd3jax.training.jobs import make_jobs

LANES, CORES = 5, 2


def seconds_to_write(algorithm: str, capacity: int, repeats: int) -> tuple[float, float]:
    """Median seconds of a checkpoint, and its size in MiB."""
    config = rtd.Config(algorithm=algorithm, total_steps=capacity)
    (job,) = make_jobs(rtd.make("pendulum", "random-sine"), config, [0])
    state = jax.jit(job.program.init)(job.lane)
    with tempfile.TemporaryDirectory() as name:
        checkpoints = Checkpoints(lambda job: pathlib.Path(name), lambda job: {})
        times = []
        for step in range(repeats):
            began = time.perf_counter()
            checkpoints.save_lane(job, state, step)
            times.append(time.perf_counter() - began)
        size = max(file.stat().st_size for file in pathlib.Path(name).iterdir())
    return statistics.median(times), size / 2**20


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small, once")
    quick = parser.parse_args(arguments).quick
    print("| agent | replay | MiB | seconds | overhead |\n|---|---|---|---|---|")
    for capacity in (1_000,) if quick else (30_000, 1_000_000):
        for algorithm in ("h-td3",) if quick else ("td3", "lstm-td3-1ha1hc", "h-td3"):
            seconds, size = seconds_to_write(algorithm, capacity, 1 if quick else 7)
            interval = max(DEFAULT_SECONDS, _PATIENCE * seconds)
            share = LANES * seconds / (CORES * interval)
            print(
                f"| {algorithm} | {capacity:,} | {size:,.1f} | {seconds:.3f} | {share:.3%} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
