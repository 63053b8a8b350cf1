"""Trains sb3-contrib's RecurrentPPO on InvertedPendulum-v5 with hidden velocities.

Usage: python -m experiments.benchmarks.recurrent_ppo [--quick] [--out FILE]

`MlpLstmPolicy` with the package's defaults, as its documentation uses it: 30,000 steps, three
seeds, the final deterministic policy tested on 100 episodes, as
experiments/gymnasium_simulators.py tests the agents of this package. sb3-contrib is not a
dependency; it needs an environment of its own: `pip install sb3-contrib pandas jax
'gymnasium[mujoco]'`. The script writes experiments/results/benchmarks/recurrent_ppo.csv: a row per
seed. A seed that has a row is not trained again.
"""

import argparse
import importlib.metadata
import pathlib
import sys
import time

import gymnasium
import numpy as np
import pandas as pd
import torch
from sb3_contrib import RecurrentPPO

from experiments.searching import go_through
from experiments.writing import BENCHMARKS, parse

SEEDS, STEPS, EPISODES, KEEP = 3, 30_000, 100, (0, 1)


def make() -> gymnasium.Env:
    """The simulator, of which only position and angle are observed."""
    env = gymnasium.make("InvertedPendulum-v5")
    seen = env.observation_space
    hidden = gymnasium.spaces.Box(seen.low[list(KEEP)], seen.high[list(KEEP)], dtype=seen.dtype)
    return gymnasium.wrappers.TransformObservation(env, lambda full: full[list(KEEP)], hidden)


def tested(model: RecurrentPPO, episodes: int, seed: int) -> np.ndarray:
    """The returns of the deterministic policy, float64 [episodes]."""
    env = make()
    returns = np.zeros(episodes)
    for episode in range(episodes):
        observation, _ = env.reset(seed=1_000_000 * (seed + 1) + episode)
        states, start, done = None, True, False
        while not done:
            action, states = model.predict(
                observation, states, episode_start=np.array([start]), deterministic=True
            )
            observation, reward, terminated, truncated, _ = env.step(action)
            returns[episode] += float(reward)
            start, done = False, terminated or truncated
    return returns


def trained(seed: int, steps: int, episodes: int) -> dict[str, object]:
    """Train and test one seed."""
    began = time.process_time()
    model = RecurrentPPO("MlpLstmPolicy", make(), seed=seed, device="cpu")
    model.learn(steps)
    seconds = time.process_time() - began
    return {
        "steps": model.num_timesteps,
        "mean": float(np.mean(tested(model, episodes, seed))),
        "cpu_seconds": round(seconds, 1),
        "sb3_contrib": importlib.metadata.version("sb3-contrib"),
        "gymnasium": gymnasium.__version__,
    }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--out", type=pathlib.Path, default=BENCHMARKS / "recurrent_ppo.csv")
    options = parse(parser, arguments)
    seeds, steps, episodes = (1, 128, 2) if options.quick else (SEEDS, STEPS, EPISODES)
    torch.set_num_threads(1)
    go_through(
        ({"seed": seed} for seed in range(seeds)),
        lambda setting: trained(setting["seed"], steps, episodes),
        options.out,
        {"seed": 0},
    )
    means = pd.read_csv(options.out)["mean"]
    print(f"{means.mean():.1f} ± {means.std():.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
