"""Compares the speed of segments and windows: whole training steps of one agent.

Usage: python -m experiments.benchmarks.segments [--quick] [--agent A] [--lengths L ...]
                                                 [--segment-lengths M ...] [--repeats N]
                                                 [--seconds S] [--batch-size B] [--torch]
                                                 [--out DIR]

One lane per core trains on the rover under AR(1) slip: environment step, replay and all updates.
The variants are measured alternately, each ratio is computed from measurements that follow each
other, and the table has the median. With ``--torch``, PyTorch's windows are measured too, in a
process per core. The script writes segments.md, .parquet and .json to --out.
"""

import argparse
import contextlib
import pathlib
import sys
import time

import numpy as np
import pandas as pd

import rtd3jax as rtd
from experiments.benchmarks.bench import machine
from experiments.benchmarks.ours import Lanes, make_config
from experiments.benchmarks.torch_processes import PROCESS_PER_CORE, TorchProcesses
from rtd3jax.training.devices import workers

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
from writing import BENCHMARKS, markdown_table, parse, provenance, write_results  # noqa: E402


def ways(segment_lengths: list[int], batch_size: int) -> dict[str, dict[str, object]]:
    """Fields of the configuration by name; windows first."""
    found: dict[str, dict[str, object]] = {"windows": {}}
    for m in segment_lengths:
        segments = {"replay": "segments", "segment_length": m}
        found[f"{batch_size // m} x {m}"] = segments
        found[f"{batch_size // m} x {m}, cut"] = {**segments, "burn_in_gradient": False}
    return found


TORCH = "PyTorch, windows"


def measure(options: argparse.Namespace, torch: TorchProcesses | None) -> pd.DataFrame:
    """Milliseconds of a core for a step: columns history_length, way, repeat, milliseconds."""
    rows, cores = [], len(workers())
    for length in options.lengths:
        sides = {}
        for name, fields in ways(options.segment_lengths, options.batch_size).items():
            size = {"hidden_size": options.width, "batch_size": options.batch_size}
            config = make_config(options.agent, length, **size, **fields)
            sides[name] = Lanes(config, cores)
            sides[name].warm_up(options.seconds / 3)
        if torch is not None:
            torch.prepare(
                agent=options.agent,
                history_length=length,
                width=options.width,
                batch=options.batch_size,
                capacity=config.capacity,
                learning_starts=options.batch_size,
                warm_up=4,
            )
        for repeat in range(options.repeats):
            for name, lanes in sides.items():
                steps, seconds = lanes.run(options.seconds)
                rows.append((length, name, repeat, 1e3 * seconds * cores / steps))
            if torch is not None:
                rate = torch.run(PROCESS_PER_CORE, options.seconds)
                rows.append((length, TORCH, repeat, 1e3 * cores / rate))
        print(f"l={length}: measured", flush=True)
    return pd.DataFrame(rows, columns=["history_length", "way", "repeat", "milliseconds"])


def table(found: pd.DataFrame) -> str:
    """Milliseconds and, in brackets, the ratio of the windows' time to this time."""
    names = list(dict.fromkeys(found["way"]))
    body = []
    for length, rows in found.groupby("history_length", sort=False):
        taken = rows.pivot(index="repeat", columns="way", values="milliseconds")
        line = [str(length)]
        for name in names:
            ratio = float(np.median(taken["windows"] / taken[name]))
            line.append(f"{np.median(taken[name]):.2f} ({ratio:.2f})")
        body.append(line)
    return markdown_table(["l", *names], body)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--agent", choices=rtd.ALGORITHMS, default="lstm-td3-1ha1hc")
    parser.add_argument("--lengths", nargs="+", type=int, default=[1, 6, 10, 20])
    parser.add_argument("--segment-lengths", nargs="+", type=int, default=[5, 10, 20])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--batch-size", type=int, default=100)
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--torch", action="store_true", help="also measure PyTorch's windows")
    parser.add_argument("--out", type=pathlib.Path, default=BENCHMARKS)
    options = parse(parser, arguments)
    if options.quick:
        options.lengths, options.segment_lengths, options.repeats = [1], [5], 1
        options.seconds, options.batch_size, options.width = 0.05, 10, 8
    began = time.time()
    with contextlib.ExitStack() as stack:
        cores = len(workers())
        torch = stack.enter_context(TorchProcesses(cores, cores)) if options.torch else None
        found = measure(options, torch)
    text = table(found)
    facts = provenance(
        agent=options.agent,
        columns="segments x segment length; cut: without the burn-in's gradient",
        cells="milliseconds of a core per step, and in brackets how many times as fast as windows",
        width=options.width,
        batch_size=options.batch_size,
        repeats=options.repeats,
        machine=machine(),
        minutes=round((time.time() - began) / 60, 1),
    )
    write_results(options.out, "segments", found, text, facts)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
