"""Compares sixteen environments with one, with equal transitions and updates, on the rover.

Usage: python experiments/many_environments.py [--quick] [--seeds N] [--out DIR]

The agent is `lstm-td3-1ha1hc` under AR(1) slip with the settings of the preset `rover`. There are
five paired seeds, each tested in 1,000 episodes. Both variants are trained alternately, seed by
seed, and their time is that of the processor, so other work on the machine affects both alike. The
script writes many_environments.md, .parquet and .json; existing rows are kept.
"""

import argparse
import itertools
import pathlib
import sys
import time

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.study.presets import ROVER_HISTORY_LENGTH, ROVER_SETTINGS, ROVER_STEPS

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from effects import mean_interval  # noqa: E402
from writing import RESULTS, markdown_table, parse, provenance, write_results  # noqa: E402

AGENT, DISTURBANCE, COUNTS, EPISODES, SEEDS = "lstm-td3-1ha1hc", "ar1-slip", (1, 16), 1_000, 5


def trained(count: int, seed: int, episodes: int, tiny: dict[str, object]) -> dict[str, object]:
    """Train and test one lane of ``count`` environments."""
    env = rtd.make("rover", DISTURBANCE)
    fields = {**ROVER_SETTINGS, "total_steps": ROVER_STEPS, **tiny, "environments": count}
    config = rtd.Config(AGENT, ROVER_HISTORY_LENGTH, **fields)
    began = time.process_time()
    run = rtd.train(env, config, [seed], progress=False)
    seconds = time.process_time() - began
    returns = rtd.evaluate(run.policy(seed), env, episodes, seed=seed)
    return {
        "environments": count,
        "seed": seed,
        "mean": float(np.mean(returns)),
        "cpu_seconds": seconds,
        "updates": config.updates,
    }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parse(parser, arguments)
    tiny, episodes = {}, EPISODES
    if options.quick:
        tiny = {"total_steps": 160, "hidden_size": 4, "batch_size": 4, "learning_starts": 16}
        tiny |= {"eval_every": 160, "eval_episodes": 1}
        options.seeds, episodes = 2, 2
    else:  # compile both programs before the measurements
        for count in COUNTS:
            trained(count, 99, 1, {"total_steps": 2_000})
    path = options.out / "many_environments.parquet"
    rows = pd.read_parquet(path).to_dict("records") if path.exists() else []
    for seed, count in itertools.product(range(options.seeds), COUNTS):
        if any((row["seed"], row["environments"]) == (seed, count) for row in rows):
            continue
        rows.append(trained(count, seed, episodes, tiny))
        print(rows[-1], flush=True)
        options.out.mkdir(parents=True, exist_ok=True)
        pd.DataFrame(rows).to_parquet(path, index=False)
    table = pd.DataFrame(rows)
    one, many = (table[table["environments"] == count] for count in COUNTS)
    differences = many["mean"].to_numpy() - one["mean"].to_numpy()
    mean, low, high = mean_interval(differences)
    share = many["cpu_seconds"].mean() / one["cpu_seconds"].mean()
    timed = int(table["cpu_seconds"].notna().sum()) // len(COUNTS)
    body = [
        [
            str(count),
            f"{own['mean'].mean():.3f} ± {own['mean'].std():.3f}",
            f"{own['cpu_seconds'].mean():.1f}",
            f"{own['updates'].iloc[0]:,}",
        ]
        for count, own in table.groupby("environments")
    ]
    text = markdown_table(["environments", "return", "CPU seconds a lane", "updates"], body)
    text += (
        f"\n\nDifference of pairs {mean:+.3f} [{low:+.3f}, {high:+.3f}] (95%); "
        f"{share:.2f} of the processor's time ({timed} pairs).\n"
    )
    steps = tiny.get("total_steps", ROVER_STEPS)
    write_results(
        options.out,
        "many_environments",
        table,
        text,
        provenance(agent=AGENT, disturbance=DISTURBANCE, episodes=episodes, steps=steps),
    )
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
