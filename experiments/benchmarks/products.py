"""Measures the matrix products of an update alone, each with its own shape, on all cores.

Usage: python -m experiments.benchmarks.products [--quick] [--lengths L ...] [--threads N]
                                                 [--out DIR]

The script measures every product of an update of `lstm-td3-1ha1hc` (batch 100, width 128)
separately. XLA compiles each for one thread, and as many threads as cores repeat it in one program,
with operands in the cache. The sum of the times is the time of an update in which gates,
activations, gathers, optimisers, acting and the environment take no time. The table compares it
with the time of a step, and with the rate of a large product; no step with these products can have
a larger share of this rate than the sum. The script writes products.md.
"""

import argparse
import dataclasses
import pathlib
import statistics
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.ours import Lanes, make_config
from rtd3jax.study.flops import update_flops
from rtd3jax.training.devices import workers

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
from writing import BENCHMARKS, markdown_table, parse  # noqa: E402

AGENT = "lstm-td3-1ha1hc"
SERIAL = {"xla_cpu_multi_thread_eigen": False}


@dataclasses.dataclass(frozen=True)
class Product:
    """[m, k] times [k, n], ``count`` times per update; ``transposed`` is about the left factor."""

    name: str
    m: int
    k: int
    n: int
    count: float
    transposed: bool = False

    @property
    def flops(self) -> float:
        """Operations of one product."""
        return 2.0 * self.m * self.k * self.n


def products_of(length: int, batch: int, width: int) -> list[Product]:
    """The large products of an update; delayed updates count half."""
    rest, gates = length * batch, 4 * width
    # Forward: target actor, two target critics, two critics; actor and critic every second step.
    forward, backward = 5 + 1.0, 2 + 0.5
    return [
        Product("input, first token", batch, width, gates, forward),
        Product("input, the other tokens", rest, width, gates, forward),
        Product("recurrent, forward", batch, width, gates, forward * length),
        Product("recurrent, backward", batch, gates, width, backward * length),
        Product("weights' gradients", width, rest, gates, 2 * backward, transposed=True),
        Product("inputs' gradient", rest, gates, width, backward),
        Product("first token, backward", batch, gates, width, backward),
        Product("first token, weights", width, batch, gates, backward, transposed=True),
        # In the actor's loss the critic sends a gradient back to the action, by its last token.
        Product("last token, to the action", batch, gates, width, 0.5),
        Product("heads", batch, width, width, forward + 2 * backward + 0.5),
    ]


def seconds(product: Product, least: float, rounds: int, threads: int) -> float:
    """Seconds per product with ``threads`` threads: the minimum over rounds of a loop."""
    random = np.random.default_rng(0)
    left = (product.k, product.m) if product.transposed else (product.m, product.k)
    x = jnp.asarray(random.standard_normal(left, np.float32))
    y = jnp.asarray(random.standard_normal((product.k, product.n), np.float32))

    def repeat(x, y, times):
        def once(_, x):
            # Barriers, so that XLA computes the whole product, not only the element that is read.
            factor = jax.lax.optimization_barrier(x)
            z = jax.lax.optimization_barrier((factor.T if product.transposed else factor) @ y)
            return x.at[0, 0].set(z[0, 0] * 1e-3)

        return jax.lax.fori_loop(0, times, once, x)

    run = jax.jit(repeat, compiler_options=SERIAL).lower(x, y, jnp.int32(1)).compile()

    def work(times: int) -> None:
        jax.block_until_ready(run(x, y, jnp.int32(times)))

    with ThreadPoolExecutor(threads) as pool:

        def clock(times: int) -> float:
            began = time.perf_counter()
            list(pool.map(work, [times] * threads))
            return time.perf_counter() - began

        times = 1
        while clock(times) <= least:
            times *= 2
        return min(clock(times) for _ in range(rounds)) / times / threads


def step_seconds(
    length: int, batch: int, width: int, least: float, rounds: int, threads: int
) -> float:
    """Seconds per seed-step with a lane for each thread, in the sweep's program: the minimum."""
    lanes = Lanes(make_config(AGENT, length, batch_size=batch, hidden_size=width), threads)
    lanes.warm_up(least)
    found = []
    for _ in range(rounds):
        steps, took = lanes.run(least)
        found.append(took / steps)
    return min(found)


def report(
    length: int, batch: int, width: int, size: int, least: float, rounds: int, threads: int
) -> str:
    """The table of one window length."""
    large = Product("large", size, size, size, 1)
    rate = statistics.median(
        large.flops / seconds(large, least, rounds, threads) for _ in range(1 if rounds == 1 else 3)
    )
    body, total = [], 0.0
    for product in products_of(length, batch, width):
        each = seconds(product, least, rounds, threads)
        total += product.count * each
        body.append(
            [
                product.name,
                f"{product.m} × {product.k} × {product.n}",
                f"{product.count:g}",
                f"{1e3 * product.count * each:.2f}",
                f"{product.flops / each / rate:.2f}",
            ]
        )
    flops = update_flops(make_config(AGENT, length, batch_size=batch, hidden_size=width))
    step = step_seconds(length, batch, width, least, rounds, threads)
    body.append(
        ["**products alone**", "", "", f"**{1e3 * total:.2f}**", f"**{flops / total / rate:.2f}**"]
    )
    body.append(
        [
            "**the whole step**",
            "",
            "",
            f"**{1e3 * step:.2f}**",
            f"**{flops / step / rate:.2f}**",
        ]
    )
    header = ["product", "m × k × n", "an update", "ms an update", "of the large product's rate"]
    where = "one core" if threads == 1 else f"{threads} cores together"
    title = f"## l = {length}: large products run at {rate / 1e9:.0f} GFLOP/s on {where}"
    return f"{title}\n\n{markdown_table(header, body)}\n"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a small run to test the script")
    parser.add_argument("--lengths", type=int, nargs="+", default=[1, 6, 20])
    parser.add_argument("--threads", type=int, default=len(workers()), help="[one per core]")
    parser.add_argument("--out", type=pathlib.Path, default=BENCHMARKS)
    options = parse(parser, arguments)
    batch, width, size, least, rounds = 100, 128, 2048, 0.3, 5
    if options.quick:
        batch, width, size, least, rounds, options.lengths = 4, 8, 64, 1e-4, 1, [1]
    sizes = batch, width, size, least, rounds, options.threads
    text = "\n".join(report(n, *sizes) for n in options.lengths)
    device = f"{jax.devices()[0].device_kind}, JAX {jax.__version__}, threads: {options.threads}"
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "products.md").write_text(f"{text}\n{device}\n")
    print(text)


if __name__ == "__main__":
    main()
