"""Measures the time until the mean of five seeds on the rover exceeds the paper's best return.

Usage: python -m experiments.benchmarks.time_to_return [--quick] [--run DIR] [--out DIR]

The script trains `lstm-td3-1ha1hc` under AR(1) slip with the settings of `--preset quick`, in a new
directory and without JAX's persistent cache. The time is from the start of the process to the first
evaluation (20 episodes per seed) at which the mean over the seeds is above -1.36 and stays there.
The script writes time_to_return.md, .parquet and .json.
"""

import argparse
import json
import os
import pathlib
import sys
import time

BEGAN = time.time()
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"

import pandas as pd  # noqa: E402

import rtd3jax as rtd  # noqa: E402
from experiments.benchmarks.bench import machine  # noqa: E402
from rtd3jax.study.cells import make_cells  # noqa: E402
from rtd3jax.study.presets import PRESETS  # noqa: E402

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
from writing import BENCHMARKS, markdown_table, parse, provenance, write_results  # noqa: E402

AGENT, PAPERS_BEST, SEEDS, EPISODES = "lstm-td3-1ha1hc", -1.36, 5, 20


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/time_to_return"))
    parser.add_argument("--out", type=pathlib.Path, default=BENCHMARKS)
    options = parse(parser, arguments)
    if (options.run / "log.jsonl").exists():
        print(f"{options.run} holds a study already: a new one must be timed", file=sys.stderr)
        return 2
    fields: dict[str, object] = {"eval_episodes": EPISODES}
    if options.quick:
        fields = {"total_steps": 40, "hidden_size": 4, "batch_size": 4, "learning_starts": 8}
        fields |= {"eval_every": 20, "eval_episodes": 1}
    cells = [c for c in make_cells(PRESETS["quick"], fields) if c.config.algorithm == AGENT]
    study = rtd.Study(cells, seeds=range(SEEDS), out=options.run)
    before = time.time() - BEGAN
    lost = study.run(quiet=True, page=False)
    total = time.time() - BEGAN
    rows = [json.loads(line) for line in (options.run / "log.jsonl").read_text().splitlines()]
    found = pd.DataFrame(rows)[["seed", "step", "return", "seconds"]]
    curve = found.groupby("step").agg(
        mean=("return", "mean"), seeds=("seed", "count"), seconds=("seconds", "max")
    )
    above = curve["mean"][::-1].cummin()[::-1] > PAPERS_BEST
    reached = curve[above & (curve["seeds"] == SEEDS)]
    first = reached.iloc[0] if len(reached) else None
    text = markdown_table(
        ["what", "value"],
        [
            ["seconds until the mean stays above -1.36", _text(first, before)],
            ["at step", "never" if first is None else f"{reached.index[0]:,}"],
            ["mean of the last evaluation", f"{curve['mean'].iloc[-1]:.3f}"],
            ["seconds until all is trained and written", f"{total:.0f}"],
        ],
    )
    facts = provenance(agent=AGENT, seeds=SEEDS, episodes=EPISODES, machine=machine(), lost=lost)
    write_results(options.out, "time_to_return", curve.reset_index(), text, facts)
    print(text)
    return 0


def _text(first: pd.Series | None, before: float) -> str:
    """Seconds since the start of the process; the log counts from the start of the study."""
    return "never" if first is None else f"{before + float(first['seconds']):.0f}"


if __name__ == "__main__":
    sys.exit(main())
