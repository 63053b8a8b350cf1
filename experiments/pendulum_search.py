"""Which setting lets every agent swing up the pendulum whose velocity is hidden?

Usage: python experiments/pendulum_search.py [--quick] [--out FILE]

The paper's pendulum figures are 670 trainings of width 128, half of whose cost is at l = 20; so the
setting that is sought is the best of those that make about 7,500 updates of 100 transitions, or as
many operations in smaller batches. It is sought with `lstm-td3-no-action`, which was furthest from
the goal of the agents that share a setting, and with `h-td3`, whose critics read carries that an
actor of long ago stored and which has fields of its own. Seeds from 100 on are not reported
elsewhere. Writes experiments/results/pendulum_search.csv: a row per setting, with the final
policies' normalised return over 400 episodes. A setting whose row is there already is not trained
again. Rows of an earlier search, whose agents read actions in N m, stay at the top.
"""

import pathlib
import sys
import time

import numpy as np

import rtd3jax as rtd
from rtd3jax.envs.registry import parse_disturbance

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
"""What rows of the earlier search lack they had at these values."""
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
    # More and smaller updates; faster targets; a smoothed value.
    {**HALF_BATCHES, **FASTER, "update_every": 1, "batch_size": 32, "total_steps": 20_000},
    {**HALF_BATCHES, **FASTER, "tau": 0.02},
    {**HALF_BATCHES, **FASTER, "actor_noise": 0.1},
    {**HALF_BATCHES, **FASTER, "algorithm": "lstm-td3-1ha1hc"},
    # h-td3 explores more, forgets sooner and has a slower actor; an update of it costs less.
    {**HALF_BATCHES, **FASTER, **CARRIED},
    {**HALF_BATCHES, **FASTER, **CARRIED, "tau": 0.005},
    {**HALF_BATCHES, **CARRIED, "update_every": 1},
)
"""What each setting changes in `BASE`."""


def search(setting: dict, episodes: int) -> dict:
    """Train the setting and evaluate it; the results of a row."""
    began = time.perf_counter()
    others = ("actions", "disturbance", "seeds")
    config = rtd.Config(**{name: value for name, value in setting.items() if name not in others})
    disturbance = setting["disturbance"]
    name, parameters = parse_disturbance(disturbance)
    env = rtd.make("pendulum", name, **parameters)
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
