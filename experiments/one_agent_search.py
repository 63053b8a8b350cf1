"""One agent for structure and for noise: which training makes it good under both?

Usage: python experiments/one_agent_search.py [--quick] [--only N ...] [--out FILE]

The paper's agents are trained under one disturbance, and those of a sine fail under noise. Here
each episode of the training draws its disturbance from a mixture. Each setting has two seeds, from
100 on, which are not reported elsewhere, and is tested on 400 episodes of each condition. The
script writes experiments/results/one_agent_search.csv: a row per setting that was trained, losers
included. A setting that has a row is not trained again; `--only` names settings by their place in
`CHANGES`.

`structured` is the return under the worst structured condition of each seed, as a mean over seeds
and normalised (0 is the uniform random policy, 1 the fully observed optimum). The columns of noise
have the normalised returns under noise, divided by that of the model-based reference
(`experiments/filter_reference.py`), a Bayes filter that knows the process.
"""

import pathlib
import sys
import time

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.study import presets

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from pendulum import scale  # noqa: E402
from searching import search_main  # noqa: E402
from writing import RESULTS  # noqa: E402

SEARCHED = RESULTS / "one_agent_search.csv"
FIRST_SEED, SEEDS = 100, 2
STRUCTURED = (
    "random-sine",
    "temporal-sine",
    "combined-sine",
    "damped-sine",
    "temporal-bias:amplitude_min=1.0,amplitude_max=1.0",
)
NOISY = {"noise:sigma=0.5": "noise:reward_from=state", "noise:sigma=1.0": "noise:sigma=1.0"}
"""Conditions of noise, and their rows in the table of the model-based reference."""
MIXTURE = "random-sine/combined-sine/damped-sine/temporal-bias/noise"
BASE = {
    **presets.PENDULUM_SETTINGS,
    "disturbance": MIXTURE,
    "algorithm": "lstm-td3-1ha1hc",
    "memory": "lstm",
    "history_length": 20,
    "hidden_size": 64,
    "total_steps": presets.PENDULUM_STEPS,
    "replay": "segments",
    "batch_size": 100,
    "segment_length": 10,
    "burn_in_gradient": False,
    "acting": "carry",
    "normalise_observations": False,
}
LONGER = {"total_steps": 60_000}
PRIVILEGED = {"algorithm": "lstm-td3-privileged"}
"""Its critics read the undisturbed observation; the policy does not."""
FOUR = "random-sine/temporal-sine/temporal-bias/noise:weights=(1,1,1,3)"
FIVE = "random-sine/temporal-sine/combined-sine/temporal-bias/noise"
CHANGES: tuple[dict, ...] = (
    {},
    {"disturbance": f"{MIXTURE}:weights=(1,1,1,1,4)"},
    {"disturbance": "random-sine"},
    {"disturbance": "noise:reward_from=state"},
    {"update_every": 1},
    {"memory": "gru"},
    LONGER,
    {"history_length": 40},
    {"hidden_size": 128},
    PRIVILEGED,
    {**PRIVILEGED, "disturbance": "noise:reward_from=state"},
    {
        **PRIVILEGED,
        "disturbance": "noise:reward_from=state",
        "total_steps": 120_000,
        "history_length": 40,
    },
    {
        **PRIVILEGED,
        "disturbance": f"{FIVE}:weights=(2,2,3,1,5)",
        "total_steps": 120_000,
        "update_every": 1,
    },
    {
        **PRIVILEGED,
        "disturbance": f"{FIVE}:weights=(1,1,1,1,2)",
        "total_steps": 120_000,
        "history_length": 40,
    },
    {**PRIVILEGED, **LONGER, "disturbance": FOUR, "update_every": 1},
    {**PRIVILEGED, **LONGER, "disturbance": FOUR, "history_length": 40},
    {**PRIVILEGED, **LONGER, "disturbance": FOUR, "hidden_size": 128},
)
"""What each setting changes in `BASE`."""


def results_of(policy: rtd.Policy, episodes: int) -> dict[str, float]:
    """Normalised return under each condition."""
    found = {}
    for condition in (*STRUCTURED, *NOISY):
        env = rtd.make("pendulum", condition)
        low, high = scale(condition)
        mean = float(np.mean(rtd.evaluate(policy, env, episodes, 9, true_reward=True)))
        found[condition] = (mean - low) / (high - low)
    return found


def reference() -> dict[str, float]:
    """The model-based reference's normalised return under each condition of noise."""
    table = pd.read_parquet(RESULTS / "filter_reference.parquet").set_index("disturbance")
    return {condition: float(table["normalised"][row]) for condition, row in NOISY.items()}


def search(setting: dict, episodes: int) -> dict:
    """Train the setting and test it; return the results of its row."""
    began = time.process_time()
    fields = {name: value for name, value in setting.items() if name != "disturbance"}
    env = rtd.make("pendulum", setting["disturbance"])
    seeds = range(FIRST_SEED, FIRST_SEED + SEEDS)
    run = rtd.train(env, rtd.Config(**fields), seeds, progress=False)
    minutes = (time.process_time() - began) / 60 / SEEDS
    each = pd.DataFrame([results_of(run.policy(seed), episodes) for seed in seeds])
    known = reference()
    row = {"structured": each[list(STRUCTURED)].min(axis=1).mean()}
    row |= {condition: (each[condition] / known[condition]).mean() for condition in NOISY}
    row |= {f"{name} (normalised)": each[name].mean() for name in STRUCTURED}
    return {name: round(float(value), 3) for name, value in row.items()} | {
        "cpu_minutes_a_lane": round(minutes, 2)
    }


def main(arguments: list[str] | None = None) -> None:
    search_main(arguments, __doc__, SEARCHED, BASE, CHANGES, search, episodes=400)


if __name__ == "__main__":
    main()
