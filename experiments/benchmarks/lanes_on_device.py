"""Measures seed-steps per second for numbers of lanes in one program (``vmap``), on one device.

Usage: python -m experiments.benchmarks.lanes_on_device [--quick] [--agent A] [--lengths L ...]
                                                        [--lanes N ...] [--seconds S] [--out FILE]

The numbers of lanes are 1, 2, 4, ..., 1024. First each length has its own program; then the lanes
of one program have all lengths, with windows of the maximum length, as in a sweep on an
accelerator. The script prints a Markdown table with the name of the device. A column ends at the
number of lanes that does not fit in memory.
"""

import argparse
import pathlib
import sys
from collections.abc import Iterator

import jax

import rtd3jax as rtd
from experiments.benchmarks.ours import Lanes, make_config
from rtd3jax.errors import UserError
from rtd3jax.system.files import write_bytes_atomically


def columns(options: argparse.Namespace) -> dict[str, tuple[list[rtd.Config], int | None]]:
    """For each title, the configurations of the lanes and their common window."""
    sizes = {"hidden_size": options.hidden_size, "batch_size": options.batch_size}
    sizes["replay_capacity"] = 200 if options.quick else 10_000
    configs = [make_config(options.agent, length, **sizes) for length in options.lengths]
    found: dict[str, tuple[list[rtd.Config], int | None]] = {
        f"l = {config.history_length}": ([config], None) for config in configs
    }
    if len(configs) > 1:
        longest = max(options.lengths)
        mixed = ", ".join(map(str, options.lengths))
        found[f"l of {mixed}, padded to {longest}"] = (configs, longest)
    return found


def rates(configs: list[rtd.Config], window: int | None, options) -> Iterator[float | None]:
    """Seed-steps per second for each number of lanes; None if the memory is too small."""
    fits = True
    for count in options.lanes:
        rate = None
        if fits:
            try:
                rate = _rate(configs, window, count, options.seconds)
            except jax.errors.JaxRuntimeError as error:
                if "RESOURCE_EXHAUSTED" not in str(error):
                    raise
                fits = False
        print(f"{count} lanes: {'out of memory' if rate is None else f'{rate:.0f}/s'}", flush=True)
        yield rate


def _rate(configs: list[rtd.Config], window: int | None, count: int, seconds: float) -> float:
    lanes = Lanes(configs, count, strategy="vmap", devices=1, window=window)
    lanes.warm_up(seconds / 2)
    steps, passed = lanes.run(seconds)
    return steps / passed


def table(options: argparse.Namespace) -> str:
    """The Markdown table."""
    found = {}
    for title, (configs, window) in columns(options).items():
        print(title, flush=True)
        found[title] = list(rates(configs, window, options))
    device = jax.devices()[0]
    lines = [
        f"Seed-steps/s of {options.agent} on one {device.device_kind} ({device.platform}), lanes "
        f"side by side, batch {options.batch_size}, width {options.hidden_size}, jax "
        f"{jax.__version__}; in brackets, over that of the fewest.",
        "",
        f"| lanes | {' | '.join(found)} |",
        f"|{'---|' * (1 + len(found))}",
    ]
    for index, count in enumerate(options.lanes):
        cells = [_cell(column[index], column[0]) for column in found.values()]
        lines.append(f"| {count} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _cell(rate: float | None, first: float | None) -> str:
    return "out of memory" if rate is None else f"{rate:.0f} ({rate / (first or rate):.1f})"


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The options, after the changes of ``--quick``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="tiny: two lanes")
    parser.add_argument("--agent", choices=rtd.ALGORITHMS, default="lstm-td3-1ha1hc")
    parser.add_argument("--lengths", nargs="+", type=int, metavar="L", help="[1 20]")
    parser.add_argument("--lanes", nargs="+", type=int, metavar="N", help="[1 2 4 ... 1024]")
    parser.add_argument("--seconds", type=float, help="duration of each measurement [2]")
    parser.add_argument("--out", type=pathlib.Path, help="also write the table to this file")
    options = parser.parse_args(arguments)
    quick = options.quick
    options.lengths = options.lengths or ([1] if quick else [1, 20])
    powers = [2] if quick else [2**power for power in range(11)]
    options.lanes = sorted(options.lanes or powers)
    options.seconds = options.seconds or (0.05 if quick else 2.0)
    options.hidden_size, options.batch_size = (8, 10) if quick else (128, 100)
    if min(*options.lengths, *options.lanes) < 1 or options.seconds <= 0:
        parser.error("--lengths, --lanes and --seconds must be positive")
    if options.agent == "td3":
        options.lengths = options.lengths[:1]
    return options


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    try:
        text = table(options)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"\n{text}")
    if options.out is not None:
        write_bytes_atomically(options.out, text.encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
