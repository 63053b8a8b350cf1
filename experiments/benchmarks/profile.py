"""Measures the parts of a step: the times of the program's kernels, summed by their purpose.

Usage: python -m experiments.benchmarks.profile [--quick] [--agent A] [--lengths L ...] [--out DIR]

One lane per core trains on the rover (batch 100, width 128) under JAX's profiler. The source
location of a kernel determines its purpose. The profiler itself takes time, mostly between kernels,
so each table also has the time of a step without it ("unwatched"). The script writes profile.md.
"""

import argparse
import collections
import gzip
import json
import pathlib
import re
import sys
import tempfile
from collections.abc import Iterator

import jax

from experiments.benchmarks.ours import Lanes, make_config
from rtd3jax.agents.variants import ALGORITHMS
from rtd3jax.training.devices import workers

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
from writing import BENCHMARKS, markdown_table, parse  # noqa: E402

PRODUCTS, OPTIMISERS, LSTM = "products", "Adam and target averages", "gates, forward and backward"
LEARNING, ACTING = "the rest of the updates", "acting, environment, replay"
COPIES, RUNTIME = "copies that XLA adds", "between kernels: XLA's runtime"
RUNTIME_NAMES = ("ThunkExecutor::Execute", "SlinkyThreadPool::Await", "while", "call", "cond")


def purposes(program_text: str) -> dict[str, str]:
    """The purpose of each instruction of a compiled program, by name."""
    functions, files, places, frames = _tables(program_text)

    def chain(frame: int) -> Iterator[tuple[str, str]]:
        while frame > 0:
            place, parent = frames[frame]
            file, function = places[place]
            yield files[file], functions[function]
            frame = parent - 1  # counted from one; zero means no parent

    found = {}
    pattern = r"^\s*(?:ROOT )?%?([\w.-]+) = .*?(?:op_name=\"([^\"]*)\".*?stack_frame_id=(\d+)|$)"
    for name, path, frame in re.findall(pattern, program_text, re.MULTILINE):
        kind = re.sub(r"[.\d]+$", "", name)
        where = list(chain(int(frame))) if frame else []
        called = {function.split(".")[-1] for _, function in where}
        if kind in ("copy", "wrapped_copy") or not where:
            found[name] = COPIES
        elif path.endswith("dot_general"):
            found[name] = PRODUCTS
        elif called & {"_descend", "average"}:
            found[name] = OPTIMISERS
        elif any(file.endswith("agents/memory/lstm.py") for file, _ in where) and "learn" in called:
            found[name] = LSTM
        elif "learn" in called and "sample" not in called:
            found[name] = LEARNING
        else:
            found[name] = ACTING
    return found


def _tables(text: str):
    """Names of functions and files, (file, function) of places, (place, parent) of frames."""

    def section(title: str) -> str:
        return text.split(f"\n{title}\n", 1)[1].split("\n\n", 1)[0]

    def names(title: str) -> dict[int, str]:
        return {int(i): name for i, name in re.findall(r'^(\d+) "(.*)"$', section(title), re.M)}

    def pairs(title: str, first: str, second: str) -> dict[int, tuple[int, int]]:
        pattern = rf"^(\d+) {{.*?{first}=(\d+).*?{second}=(\d+).*}}$"
        found = re.findall(pattern, section(title), re.M)
        return {int(i): (int(a), int(b)) for i, a, b in found}

    return (
        names("FunctionNames"),
        names("FileNames"),
        pairs("FileLocations", "file_name_id", "function_name_id"),
        pairs("StackFrames", "file_location_id", "parent_frame_id"),
    )


def own_times(events: list[dict], purpose_of: dict[str, str]) -> collections.Counter:
    """Microseconds of each purpose: each event's time without the events nested in it."""
    threads = collections.defaultdict(list)
    for event in events:
        if event.get("ph") == "X":
            threads[event["pid"], event["tid"]].append(event)
    total: collections.Counter = collections.Counter()
    for timeline in threads.values():
        within: list[tuple[float, str | None]] = []
        for event in sorted(timeline, key=lambda e: (e["ts"], -e["dur"])):
            while within and within[-1][0] <= event["ts"]:
                within.pop()
            if within and within[-1][1] is not None:
                total[within[-1][1]] -= event["dur"]
            name = event["name"]
            purpose = purpose_of.get(name) or (RUNTIME if name in RUNTIME_NAMES else None)
            if purpose is not None:
                total[purpose] += event["dur"]
            within.append((event["ts"] + event["dur"], purpose))
    return total


def watch(lanes: Lanes, least: float, watched: float) -> tuple[dict[str, float], float]:
    """Microseconds of a core per step: for each purpose, and for a step without the profiler."""
    lanes.warm_up(least)
    steps, took = lanes.run(least)
    unwatched = 1e6 * took * len(workers()) / steps
    purpose_of = purposes(lanes.program_text())
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            steps, _ = lanes.run(watched)
        (path,) = pathlib.Path(folder).rglob("*.trace.json.gz")
        events = json.loads(gzip.decompress(path.read_bytes()))["traceEvents"]
    times = own_times(events, purpose_of).most_common()
    return {purpose: time / steps for purpose, time in times}, unwatched


def report(lanes: Lanes, title: str, least: float, watched: float) -> str:
    """The table of one program."""
    times, unwatched = watch(lanes, least, watched)
    total = sum(times.values())
    body = [[purpose, f"{time:.0f}", f"{time / total:.2f}"] for purpose, time in times.items()]
    body.append(["**together**", f"**{total:.0f}**", "**1.00**"])
    # More than the sum: threads waited, or helped with a product, for which there is no event.
    body.append(["a step unwatched", f"{unwatched:.0f}", ""])
    return f"## {title}\n\n{markdown_table(['purpose', 'µs of a core', 'share'], body)}\n"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a small run to test the script")
    parser.add_argument("--agent", choices=ALGORITHMS, default="lstm-td3-1ha1hc")
    parser.add_argument("--lengths", type=int, nargs="+", default=[1, 20])
    parser.add_argument("--out", type=pathlib.Path, default=BENCHMARKS)
    options = parse(parser, arguments)
    batch, width, least, watched = (4, 8, 0.01, 0.01) if options.quick else (100, 128, 2.0, 0.5)
    texts = []
    for length in options.lengths:
        config = make_config(options.agent, length, batch_size=batch, hidden_size=width)
        lanes = Lanes(config, len(workers()))
        texts.append(report(lanes, f"`{options.agent}`, l = {length}", least, watched))
        print(texts[-1], flush=True)
    device = f"{jax.devices()[0].device_kind}, JAX {jax.__version__}, cores: {len(workers())}"
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "profile.md").write_text("\n".join([*texts, device]) + "\n")


if __name__ == "__main__":
    main()
