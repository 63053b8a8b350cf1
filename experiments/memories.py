"""Compares memories under noise and under a random sine.

Usage: python experiments/memories.py [--quick] [--seeds N] [--out DIR]

The agent is `lstm-td3-1ha1hc` with the LSTM, the GRU and the minimal GRU (with a parallel scan),
on the pendulum under `noise` and `random-sine`: l = 20, width 64, segments, the settings of the
preset, 1,000 episodes. The script writes memories.md, .parquet and .json; existing rows are not
trained again.

Returns are normalised: 0 is the uniform random policy, 1 is the fully observed optimum.
"""

import argparse
import pathlib
import sys
import time

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.study import presets

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from pendulum import scale  # noqa: E402
from writing import RESULTS, markdown_table, parse, provenance, write_results  # noqa: E402

MEMORIES, DISTURBANCES, LENGTH, WIDTH = ("lstm", "gru", "min-gru"), ("noise", "random-sine"), 20, 64
SETTING = {
    **presets.PENDULUM_SETTINGS,
    "total_steps": presets.PENDULUM_STEPS,
    "replay": "segments",
    "batch_size": 100,
    "segment_length": 10,
    "burn_in_gradient": False,
    "history_length": LENGTH,
    "hidden_size": WIDTH,
}


def trained(memory: str, disturbance: str, seeds: int, episodes: int, tiny: dict) -> list[dict]:
    """Train and test; return a row per seed."""
    began = time.process_time()
    env = rtd.make("pendulum", disturbance)
    config = rtd.Config(**{**SETTING, "memory": memory, **tiny})
    run = rtd.train(env, config, range(seeds), progress=False)
    seconds = (time.process_time() - began) / seeds
    low, high = scale(disturbance)
    return [
        {
            "memory": memory,
            "disturbance": disturbance,
            "seed": seed,
            "normalised": (
                float(np.mean(rtd.evaluate(run.policy(seed), env, episodes, 9, true_reward=True)))
                - low
            )
            / (high - low),
            "cpu_seconds": round(seconds, 1),
        }
        for seed in range(seeds)
    ]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parse(parser, arguments)
    tiny, episodes, memories = {}, 1_000, MEMORIES
    if options.quick:
        tiny = {"total_steps": 260, "learning_starts": 250, "hidden_size": 4, "eval_every": 260}
        options.seeds, episodes, memories = 1, 2, MEMORIES[-1:]
    path = options.out / "memories.parquet"
    rows = pd.read_parquet(path) if path.exists() else pd.DataFrame()
    for disturbance in DISTURBANCES[: 1 if options.quick else None]:
        for memory in memories:
            if len(rows):
                own = rows[(rows["memory"] == memory) & (rows["disturbance"] == disturbance)]
                if len(own) >= options.seeds:
                    continue
                rows = rows.drop(own.index)  # all seeds of the cell are trained again
            new = trained(memory, disturbance, options.seeds, episodes, tiny)
            print(new, flush=True)
            rows = pd.concat([rows, pd.DataFrame(new)], ignore_index=True)
            options.out.mkdir(parents=True, exist_ok=True)
            rows.to_parquet(path, index=False)
    body = []
    for memory, own in rows.groupby("memory", sort=False):
        line = [str(memory)]
        for disturbance in DISTURBANCES:
            values = own[own["disturbance"] == disturbance]["normalised"]
            spread = f" ± {values.std():.3f}" if len(values) > 1 else ""
            line.append(f"{values.mean():.3f}{spread}" if len(values) else "not run")
        body.append([*line, f"{own['cpu_seconds'].mean():.0f}"])
    text = markdown_table(["memory", *DISTURBANCES, "CPU seconds a lane"], body)
    facts = provenance(episodes=episodes, seeds=options.seeds, setting=SETTING)
    write_results(options.out, "memories", rows, text, facts)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
