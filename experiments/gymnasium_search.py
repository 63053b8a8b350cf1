"""Balances MuJoCo's pole without seeing velocities: which training does so with every seed?

Usage: python experiments/gymnasium_search.py [--quick] [--out FILE]

The agent is `lstm-td3-1ha1hc` on InvertedPendulum-v5 with hidden velocities, for 30,000 steps. Each
setting has two seeds, from 100 on, which are not reported elsewhere; each final policy is
tested on 100 episodes (of at most 1,000 steps, with a reward of 1 for each). The script writes
experiments/results/gymnasium_search.csv: a row per setting, losers included. A setting that has a
row is not trained again. No setting has balanced the pole with all of four seeds yet.

`worst` is the lowest mean return of a seed. `action_value` is the critic's mean value at the end,
divided by that of an endless episode.
"""

import pathlib
import sys
import time

import numpy as np

import rtd3jax as rtd

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from searching import search_main  # noqa: E402
from writing import RESULTS  # noqa: E402

SEARCHED = RESULTS / "gymnasium_search.csv"
BASE = {
    "first_seed": 100,
    "seeds": 2,
    "algorithm": "lstm-td3-1ha1hc",
    "history_length": 5,
    "hidden_size": 64,
    "total_steps": 30_000,
    "replay": "segments",
    "batch_size": 100,
    "segment_length": 5,
    "acting": "carry",
    "gamma": 0.99,
    "reward_scale": 0.1,
    "tau": 0.005,
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 1e-3,
    "final_learning_rate_fraction": 1.0,
    "exploration_noise": 0.1,
    "target_noise": 0.2,
    "actor_noise": 0.0,
    "policy_delay": 2,
    "learning_starts": 1_000,
    "normalise_observations": True,
}
FASTER = {"gamma": 0.98, "tau": 0.02}
"""The critics' values reach their level in about 1 / ((1 - gamma) tau) updates, here 2,500."""
SHORT = {"gamma": 0.95, "tau": 0.02}
WINDOWS = {
    **SHORT,
    "history_length": 3,
    "replay": "windows",
    "segment_length": 0,
    "acting": "window",
}
CHANGES: tuple[dict, ...] = (
    {},
    FASTER,
    SHORT,
    {**FASTER, "final_learning_rate_fraction": 0.1},
    WINDOWS,
    {**WINDOWS, "first_seed": 102},
    {**WINDOWS, "first_seed": 102, "final_learning_rate_fraction": 0.1, "actor_noise": 0.1},
    {**SHORT, "first_seed": 102, "actor_learning_rate": 3e-4, "actor_noise": 0.1},
)
"""What each setting changes in `BASE`."""


def search(setting: dict, episodes: int) -> dict:
    """Train the setting and test it; return the results of its row."""
    began = time.process_time()
    seeds = range(setting["first_seed"], setting["first_seed"] + setting["seeds"])
    fields = {name: value for name, value in setting.items() if name not in ("first_seed", "seeds")}
    evaluations = {"eval_every": setting["total_steps"] // 6, "eval_episodes": 2}
    config = rtd.Config(**fields, **evaluations)
    env = rtd.from_gymnasium("InvertedPendulum-v5", keep=(0, 1))
    run = rtd.train(env, config, seeds, progress=False)
    minutes = (time.process_time() - began) / 60 / len(seeds)
    means = [float(np.mean(rtd.evaluate(run.policy(s), env, episodes, seed=s))) for s in seeds]
    level = config.reward_scale / (1.0 - config.gamma)
    values = run.metrics["action_value"][:, -1] / level
    return {
        "worst": round(min(means), 1),
        "mean": round(float(np.mean(means)), 1),
        "each": " ".join(f"{mean:.0f}" for mean in means),
        "curves": " / ".join(" ".join(f"{v:.0f}" for v in curve) for curve in run.returns),
        "action_value": round(float(np.mean(values)), 3),
        "cpu_minutes_a_lane": round(minutes, 2),
    }


def main(arguments: list[str] | None = None) -> None:
    search_main(arguments, __doc__, SEARCHED, BASE, CHANGES, search, episodes=100)


if __name__ == "__main__":
    main()
