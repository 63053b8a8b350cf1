"""Searches settings with which every agent swings up the pendulum with hidden velocity.

Usage: python experiments/pendulum_search.py [--quick] [--out FILE]

The paper's figures of the pendulum need 670 trainings of width 128, and half of their time is for l
= 20. So the search is limited to settings with about 7,500 updates of 100 transitions, or with the
same number of operations in smaller batches. It uses `lstm-td3-no-action`, which was the worst of
the agents with common settings, and `h-td3`, which has different settings because its critics read
carries that an old version of the actor stored. The seeds begin at 100 and are not reported
elsewhere. The script writes experiments/results/pendulum_search.csv: a row per setting, with the
normalised return of the final policies over 400 episodes. Existing rows are not trained again. Rows
of an earlier search, whose agents read actions in N m, are at the top.
"""

import pathlib
import sys
import time

import numpy as np

import rtd3jax as rtd

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from pendulum import scale  # noqa: E402
from searching import search_main  # noqa: E402

RESULTS = pathlib.Path(__file__).parent / "results" / "pendulum_search.csv"
FIRST_SEED = 100
BASE = {
    "actions": "N m",
    "disturbance": "hidden",
    "seeds": 2,
    "algorithm": "h-td3",
    "hidden_size": 64,
    "total_steps": 30_000,
    "history_length": 6,
    "batch_size": 100,
    "update_every": 1,
    "critic_learning_rate": 1e-3,
    "actor_learning_rate": 1e-3,
    "final_learning_rate_fraction": 1.0,
    "gamma": 0.99,
    "reward_scale": 1.0,
    "tau": 0.005,
    "exploration_noise": 0.1,
    "replay_capacity": 100_000,
    "actor_noise": 0.0,
    "policy_delay": 2,
}
"""Values of fields that rows of the earlier search do not have."""
_SHARED = {
    "actions": "half ranges",
    "hidden_size": 128,
    "algorithm": "lstm-td3-no-action",
    "critic_learning_rate": 3e-3,
    "actor_learning_rate": 3e-4,
    "final_learning_rate_fraction": 0.0,
    "gamma": 0.97,
    "reward_scale": 0.1,
    "exploration_noise": 0.2,
}
EVERY_FOURTH = {**_SHARED, "update_every": 4}
HALF_BATCHES = {**_SHARED, "update_every": 2, "batch_size": 50}
FASTER = {"actor_learning_rate": 1e-3, "tau": 0.01}
CARRIED = {
    "algorithm": "h-td3",
    "total_steps": 60_000,
    "exploration_noise": 0.5,
    "replay_capacity": 20_000,
    "policy_delay": 4,
}
CHANGES: tuple[dict, ...] = (
    EVERY_FOURTH,
    {**EVERY_FOURTH, **FASTER},
    HALF_BATCHES,
    {**HALF_BATCHES, **FASTER},
    # More updates with smaller batches; a higher target rate; a smoothed value.
    {**HALF_BATCHES, **FASTER, "update_every": 1, "batch_size": 32, "total_steps": 20_000},
    {**HALF_BATCHES, **FASTER, "tau": 0.02},
    {**HALF_BATCHES, **FASTER, "actor_noise": 0.1},
    {**HALF_BATCHES, **FASTER, "algorithm": "lstm-td3-1ha1hc"},
    # h-td3: more exploration, a shorter replay, a lower actor rate; its updates are faster.
    {**HALF_BATCHES, **FASTER, **CARRIED},
    {**HALF_BATCHES, **FASTER, **CARRIED, "tau": 0.005},
    {**HALF_BATCHES, **CARRIED, "update_every": 1},
)
"""The changes of each setting to `BASE`."""


def search(setting: dict, episodes: int) -> dict:
    """Train and evaluate a setting; return the results of its row."""
    began = time.perf_counter()
    others = ("actions", "disturbance", "seeds")
    config = rtd.Config(**{name: value for name, value in setting.items() if name not in others})
    disturbance = setting["disturbance"]
    env = rtd.make("pendulum", disturbance)
    seeds = range(FIRST_SEED, FIRST_SEED + setting["seeds"])
    run = rtd.train(env, config, seeds, progress=False)
    low, high = scale(disturbance)
    finals = [
        np.mean(rtd.evaluate(run.policy(seed), env, episodes, seed=9, true_reward=True))
        for seed in seeds
    ]
    normalised = (np.array(finals) - low) / (high - low)
    return {
        "normalised": round(float(normalised.mean()), 3),
        "worst_seed": round(float(normalised.min()), 3),
        "minutes": round((time.perf_counter() - began) / 60, 2),
    }


def main(arguments: list[str] | None = None) -> None:
    search_main(arguments, __doc__, RESULTS, BASE, CHANGES, search, episodes=400)


if __name__ == "__main__":
    main()
