"""Evaluates a Bayes filter that knows the disturbance: a lower bound of the optimal return.

Usage: python experiments/filter_reference.py [--quick] [--out DIR]

The script plays 1,000 episodes of `rtd.filter_policy` for each disturbance. The normalised return
is as in the other tables: 0 is the uniform random policy, 1 is the ceiling. The script writes
filter_reference.md, .parquet and .json.
"""

import argparse
import pathlib
import sys

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.evaluation.returns import both_returns

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from writing import RESULTS, markdown_table, parse, provenance, write_results  # noqa: E402

DISTURBANCES = (
    "none",
    "temporal-sine",
    "random-sine",
    "hidden",
    "noise",
    "noise:reward_from=state",
    "noise:sigma=1.0",
)
EPISODES, SEED = 1_000, 1
# Not 0: the filter's process noise was chosen on the episodes of seed 0.


def row(name: str, episodes: int, ceiling: float) -> dict[str, object]:
    """The returns of the filter under a disturbance."""
    env = rtd.make("pendulum", name)
    policy = rtd.filter_policy(env)
    given, true = (np.asarray(r, np.float64) for r in both_returns(policy, env, episodes, SEED))
    floor = rtd.evaluate(rtd.random_policy(env), env, episodes, SEED, true_reward=True)
    low = float(np.mean(floor))
    error = float(true.std(ddof=1) / np.sqrt(episodes))
    return {
        "disturbance": name,
        "true_return": float(true.mean()),
        "standard_error": error,
        "given_return": float(given.mean()),
        "random": low,
        "normalised": (float(true.mean()) - low) / (ceiling - low),
        "normalised_error": error / (ceiling - low),
    }


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one disturbance, few episodes")
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parse(parser, arguments)
    names, episodes = (("hidden",), 4) if options.quick else (DISTURBANCES, EPISODES)
    best = rtd.ceiling(rtd.make("pendulum"))
    rows = []
    for name in names:
        rows.append(row(name, episodes, best.mean))
        print(rows[-1], flush=True)
    header = ["disturbance", "true-state return", "normalised", "return of the given reward"]
    text = markdown_table(
        header,
        [
            [
                str(r["disturbance"]),
                f"{r['true_return']:.1f} ± {r['standard_error']:.1f}",
                f"{r['normalised']:.3f} ± {r['normalised_error']:.3f}",
                f"{r['given_return']:.1f}",
            ]
            for r in rows
        ],
    )
    facts = provenance(
        episodes=episodes, seed=SEED, ceiling=f"{best.mean:.2f} ± {best.standard_error:.2f}"
    )
    write_results(options.out, "filter_reference", pd.DataFrame(rows), text, facts)
    print(text)


if __name__ == "__main__":
    main()
