"""Compares returns with bfloat16 and float32 products, in pairs of seeds on the rover.

Usage: python experiments/bfloat16_returns.py [--quick] [--run DIR] [--float32 DIR] [--out DIR]

The script trains `lstm-td3-1ha1hc` under AR(1) slip with the settings of experiments/rover.py and
five seeds in both precisions. The two trainings of a pair have the same initial parameters, the
same slip and the same exploration noise, and are tested in the same 1,000 episodes. ``--float32``
names a run of experiments/rover.py for the float32 side. The script writes bfloat16_returns.md and
.parquet: a row per seed, and the mean difference with its 95% interval (Student's t over the five
differences). If you repeat the command, it only trains what is missing.
"""

import argparse
import pathlib
import sys

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.study.presets import ROVER_HISTORY_LENGTH, ROVER_SETTINGS, ROVER_STEPS
from rtd3jax.study.rundir import RunDirectory

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from effects import mean_interval  # noqa: E402
from rover import EPISODES, SEEDS  # noqa: E402
from writing import BENCHMARKS, markdown_table, parse, provenance, write_results  # noqa: E402

AGENT, DISTURBANCE = "lstm-td3-1ha1hc", "ar1-slip"


def train(run: pathlib.Path, precision: str, seeds: range, tiny: dict[str, object]) -> list[str]:
    """Train the missing lanes; return a line for each lane that was lost."""
    settings = {**ROVER_SETTINGS, "precision": precision, "total_steps": ROVER_STEPS, **tiny}
    config = rtd.Config(AGENT, ROVER_HISTORY_LENGTH, **settings)
    study = rtd.Study([rtd.Cell("rover", DISTURBANCE, config)], seeds=seeds, out=run)
    return study.run(quiet=bool(tiny), page=not tiny)


def evaluate(run: pathlib.Path, seeds: range, episodes: int) -> list[float]:
    """Mean return of each seed's policy."""
    env, which = rtd.make("rover", DISTURBANCE), {"algorithm": AGENT, "disturbance": DISTURBANCE}
    policies = [rtd.load_policy(run, **which, seed=seed) for seed in seeds]
    return [
        float(np.mean(rtd.evaluate(policy, env, episodes, seed=seed)))
        for seed, policy in zip(seeds, policies, strict=True)
    ]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/bfloat16"))
    parser.add_argument("--float32", type=pathlib.Path, help="a run of experiments/rover.py")
    parser.add_argument("--out", type=pathlib.Path, default=BENCHMARKS)
    options = parse(parser, arguments)
    tiny: dict[str, object] = {}
    seeds, episodes = range(SEEDS), EPISODES
    if options.quick:
        tiny = {"total_steps": 40, "hidden_size": 4, "batch_size": 4, "learning_starts": 10}
        tiny |= {"eval_every": 40, "eval_episodes": 1}
        seeds, episodes = range(2), 2
    runs = {"float32": options.float32 or options.run / "float32"}
    runs["bfloat16"] = options.run / "bfloat16"
    for precision, run in runs.items():
        if run != options.float32 and (lost := train(run, precision, seeds, tiny)):
            print(*lost, sep="\n", file=sys.stderr)
            return 1
    table = pd.DataFrame(
        {"seed": list(seeds), **{p: evaluate(run, seeds, episodes) for p, run in runs.items()}}
    )
    table["difference"] = table["bfloat16"] - table["float32"]
    mean, low, high = mean_interval(table["difference"].to_numpy())
    ceiling = rtd.ceiling(rtd.make("rover", DISTURBANCE)).mean
    text = markdown_table(
        ["seed", "float32", "bfloat16", "difference"],
        [[str(int(row[0])), *(f"{value:.3f}" for value in row[1:])] for row in table.to_numpy()],
    )
    text += (
        f"\nMean difference {mean:+.3f} [{low:+.3f}, {high:+.3f}], 95% interval over pairs; "
        f"positive: bfloat16 is better. The ceiling is {ceiling:.3f}.\n"
    )
    steps = RunDirectory.open(runs["bfloat16"]).cells[0].config.total_steps
    facts = provenance(agent=AGENT, disturbance=DISTURBANCE, episodes=episodes, steps=steps)
    write_results(options.out, "bfloat16_returns", table, text, facts)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
