"""Compares three ways to compute the activations of an LSTM's gates.

Usage: taskset -c 0 python -m experiments.benchmarks.gates [--quick] [--lengths L ...] [--out DIR]

Each passes forward and backward over windows of l + 1 tokens, with batch 100, width 128 and inputs
of five elements. The ways are measured alternately; the times include the products, which are the
same for all. The script writes gates.md, .parquet and .json.
"""

import argparse
import pathlib
import sys
import time
from collections.abc import Callable
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax import lax

from experiments.benchmarks.bench import LENGTHS, machine
from rtd3jax.agents.memory import lstm

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
from writing import BENCHMARKS, markdown_table, parse, provenance, write_results  # noqa: E402

INPUTS = 5
PACKAGES_OWN = lstm._activate


def gate_by_gate(gates: jax.Array, exists: jax.Array):
    """The straightforward activations; see `rtd3jax.agents.memory.lstm._activate`."""
    i, f, g, o = jnp.split(gates, 4, axis=-1)
    candidate = jnp.where(exists[:, None], jnp.tanh(g), 0.0)
    return jax.nn.sigmoid(i), jax.nn.sigmoid(f), candidate, jax.nn.sigmoid(o)


def without_barrier(gates: jax.Array, exists: jax.Array):
    """One tanh for all gates, which XLA may fuse with the slices."""
    with mock.patch.object(lax, "optimization_barrier", lambda values: values):
        return PACKAGES_OWN(gates, exists)


WAYS = {
    "one tanh, barrier": PACKAGES_OWN,
    "one tanh": without_barrier,
    "a function per gate": gate_by_gate,
}
"""The first is the package's; ratios are to it."""


def compiled(length: int, batch: int, width: int) -> tuple[Callable, tuple]:
    """Gradients of a pass over ``length`` + 1 tokens, compiled, and its arguments."""
    key, tokens = jax.random.key(0), length + 1
    params = lstm.init_lstm(key, INPUTS, width)
    inputs = jax.random.normal(key, (tokens, batch, INPUTS), jnp.float32)
    exists = jnp.ones((tokens, batch), bool)

    def loss(params, inputs):
        return jnp.sum(lstm.lstm(params, inputs, exists).hidden)

    return jax.jit(jax.grad(loss)).lower(params, inputs).compile(), (params, inputs)


def seconds(function: Callable, arguments: tuple, least: float) -> float:
    """Seconds of a call, averaged over at least ``least`` seconds."""
    calls, began = 0, time.perf_counter()
    while calls == 0 or time.perf_counter() - began < least:
        jax.block_until_ready(function(*arguments))
        calls += 1
    return (time.perf_counter() - began) / calls


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--lengths", type=int, nargs="+", default=LENGTHS)
    parser.add_argument("--out", type=pathlib.Path, default=BENCHMARKS)
    options = parse(parser, arguments)
    batch, width, rounds, least = (4, 8, 2, 1e-3) if options.quick else (100, 128, 11, 0.2)
    rows = []
    for length in options.lengths:
        sides = {}
        for way, activate in WAYS.items():
            with mock.patch.object(lstm, "_activate", activate):
                sides[way] = compiled(length, batch, width)
        first, *others = (jax.tree.leaves(function(*given)) for function, given in sides.values())
        for other in others:
            for ours, theirs in zip(first, other, strict=True):
                np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-3)
        for number in range(rounds):
            for way, (function, given) in sides.items():
                milliseconds = 1e3 * seconds(function, given, least)
                rows.append((length, way, number, milliseconds))
    table = pd.DataFrame(rows, columns=["history_length", "way", "round", "milliseconds"])
    body = []
    for length, own in table.groupby("history_length"):
        wide = own.pivot(index="round", columns="way", values="milliseconds")
        ours = wide[next(iter(WAYS))]
        cells = [f"{wide[way].median():.3f} ({(wide[way] / ours).median():.2f})" for way in WAYS]
        body.append([str(length), *cells])
    text = markdown_table(["l", *(f"{way}, ms" for way in WAYS)], body)
    text += "\n\nMedians of the rounds; in brackets, the ratio to the package's way."
    write_results(
        options.out, "gates", table, text, provenance(batch=batch, width=width, machine=machine())
    )
    print(text)


if __name__ == "__main__":
    main()
