"""Bounds of the possible speed: a step that only has products, gates and optimisers.

Usage: python -m experiments.benchmarks.bounds [--quick] [--lengths L ...] [--out DIR]

For `lstm-td3-1ha1hc` at each length, the script measures the parts of a seed-step on all cores: the
products of the updates alone (experiments/benchmarks/products.py), and with the profiler the LSTM's
gates and Adam with the target averages (experiments/benchmarks/profile.py). From these and from the
rates of PyTorch and of large products, it computes the ratios that would result if acting,
environment, replay, copies and XLA's runtime took no time. The rates are read from
measurements.csv in --out, which the benchmark must have written on this machine. The script writes
bounds.md and bounds.csv.
"""

import argparse
import pathlib
import sys

import numpy as np
import pandas as pd

from experiments.benchmarks import products, profile, report
from experiments.benchmarks.bench import LENGTHS, QUICK, Measurements, Sizes, machine
from experiments.benchmarks.ours import Lanes, make_config
from rtd3jax.errors import UserError
from rtd3jax.training.devices import workers

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
from writing import BENCHMARKS, markdown_table, parse  # noqa: E402

AGENT = products.AGENT


def measure(length: int, sizes: Sizes) -> dict[str, float]:
    """Milliseconds for a seed-step of all cores together, by part."""
    cores, quick = len(workers()), sizes is QUICK
    batch, width = sizes.batch_size, sizes.hidden_size
    least, rounds = (1e-4, 1) if quick else (0.2, 3)
    alone = sum(
        product.count * products.seconds(product, least, rounds, cores)
        for product in products.products_of(length, batch, width)
    )
    config = make_config(AGENT, length, batch_size=batch, hidden_size=width)
    times, step = profile.watch(Lanes(config, cores), *((0.01, 0.01) if quick else (2.0, 0.5)))
    of_a_core = {
        "gates": times.get(profile.LSTM, 0.0),
        "optimisers": times.get(profile.OPTIMISERS, 0.0),
        "step": step,
    }
    parts = {name: 1e-3 * microseconds / cores for name, microseconds in of_a_core.items()}
    return {"history_length": length, "products": 1e3 * alone, **parts}


def beside(measured: report.Table, length: int) -> dict[str, float]:
    """Results of the benchmark at a length: PyTorch's ms, rate of large products, ratios."""
    theirs, large = measured.torch(AGENT, length), measured.sgemm(AGENT, length)
    now, share = measured.against_torch(AGENT, length), measured.share(AGENT, length)
    if theirs is None or large is None or now is None or share is None:
        raise UserError(
            f"--out has no measurements of {AGENT} and PyTorch at l = {length}; run "
            "python -m experiments.benchmarks.bench first"
        )
    return {
        "torch": float(1e3 / np.median(theirs[1])),
        "large": float(np.median(large)),
        "ratio": float(np.median(now)),
        "share": float(np.median(share)),
    }


def bound(parts: dict[str, float], found: dict[str, float], flops: float) -> dict[str, float]:
    """The ratios of a step that only has products, gates and optimisers."""
    least = parts["products"] + parts["gates"] + parts["optimisers"]
    return {
        "ratio_bound": found["torch"] / least,
        "share_bound": flops / (1e-3 * least) / found["large"],
    }


def markdown(table: pd.DataFrame) -> str:
    """The table, and the geometric means of its ratios."""
    header = ["l", "PyTorch, ms", "step, ms", "products", "gates", "Adam and averages"]
    header += ["over PyTorch", "at most", "share of sgemm", "at most"]
    columns = ["torch", "step", "products", "gates", "optimisers"]
    columns += ["ratio", "ratio_bound", "share", "share_bound"]
    body = [
        [str(int(row["history_length"])), *(f"{row[name]:.2f}" for name in columns)]
        for row in table.to_dict("records")
    ]
    means = [f"{np.exp(np.log(table[name]).mean()):.2f}" for name in ("ratio", "ratio_bound")]
    body.append(["geometric mean", *[""] * 5, *means, "", ""])
    return markdown_table(header, body)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a small run to test the script")
    parser.add_argument("--lengths", type=int, nargs="+", default=list(LENGTHS))
    parser.add_argument("--out", type=pathlib.Path, default=BENCHMARKS)
    options = parse(parser, arguments)
    sizes = QUICK if options.quick else Sizes()
    try:
        there = Measurements(options.out / "measurements.csv", fresh=False, machine=machine())
        measured = report.Table(there.table, sizes.hidden_size, sizes.batch_size)
        found = {length: beside(measured, length) for length in options.lengths}
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    rows = []
    for length, known in found.items():
        parts = measure(length, sizes)
        rows.append({**parts, **known, **bound(parts, known, measured.flops(AGENT, length))})
    table = pd.DataFrame(rows)
    table.round(4).to_csv(options.out / "bounds.csv", index=False)
    text = (
        f"{markdown(table)}\n\nMilliseconds for a seed-step of all cores together; {machine()}.\n"
    )
    (options.out / "bounds.md").write_text(text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
