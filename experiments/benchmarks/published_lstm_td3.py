"""Trains the published code of LSTM-TD3 on InvertedPendulum-v5 with hidden velocities.

Usage: python -m experiments.benchmarks.published_lstm_td3 CHECKOUT [--quick] [--out FILE]

CHECKOUT is a clone of https://github.com/LinghengMeng/LSTM-TD3 (Meng et al., 2021); the commit is
in the table. The code runs unchanged, with the defaults of its function `lstm_td3`, except: 1,000
random steps first instead of 10,000, because there are 30,000 steps; windows of 5 steps, as on its
command line; and past actions as inputs, as in its paper. Its imports of gym, PyBullet and its
logger are replaced, because they do not install today. Like
experiments/benchmarks/recurrent_ppo.py, the script trains three seeds and tests the final policy on
100 episodes; it needs torch, pandas, jax and 'gymnasium[mujoco]'. It writes
experiments/results/benchmarks/published_lstm_td3.csv: a row per seed. A seed that has a row is not
trained again.
"""

import argparse
import importlib
import pathlib
import subprocess
import sys
import tempfile
import time
import types
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import torch

from experiments.searching import go_through
from experiments.writing import BENCHMARKS, parse

SEEDS, STEPS, EPISODES, RANDOM_STEPS, KEEP = 3, 30_000, 100, 1_000, (0, 1)
LIMIT = 1_000
"""The steps after which the simulator ends an episode."""


class Simulator:
    """The simulator with gym's old interface, of which only position and angle are observed."""

    def __init__(self) -> None:
        self._env = gymnasium.make("InvertedPendulum-v5")
        seen = self._env.observation_space
        hidden = seen.low[list(KEEP)], seen.high[list(KEEP)]
        self.observation_space = gymnasium.spaces.Box(*hidden, dtype=seen.dtype)
        self.action_space = self._env.action_space
        self._seed: int | None = None

    def __reduce__(self) -> tuple[type, tuple]:
        return object, ()  # the published code saves the simulator, and nothing reads it

    def seed(self, seed: int) -> None:
        self._seed = seed
        self.action_space.seed(seed)

    def reset(self) -> np.ndarray:
        seed, self._seed = self._seed, None  # later episodes go on with the same random numbers
        return self._env.reset(seed=seed)[0][list(KEEP)]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, dict]:
        observation, reward, terminated, _, info = self._env.step(action)
        return observation[list(KEEP)], float(reward), terminated, info


class Logger:
    """The returns of the test episodes; everything else that is logged is dropped."""

    returns: list[float]

    def __init__(self, output_dir: str, **_: Any) -> None:
        self.output_dir, self.epoch_dict = output_dir, {}
        Logger.returns = []

    def store(self, TestEpRet: float | None = None, **_: Any) -> None:
        if TestEpRet is not None:
            Logger.returns.append(TestEpRet)

    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: None


def published(checkout: pathlib.Path) -> Any:
    """The published module, with stand-ins for imports that do not install today."""

    def stand_in(name: str, **members: Any) -> None:
        module = types.ModuleType(name)
        module.__dict__.update(members)
        sys.modules[name] = module

    stand_in("gym", ObservationWrapper=object)
    stand_in("pybullet_envs")
    stand_in("lstm_td3.utils.logx", EpochLogger=Logger, setup_logger_kwargs=None, colorize=None)
    stand_in("lstm_td3.env_wrapper.env", make_bullet_task=lambda *_, **__: Simulator())
    sys.path.insert(0, str(checkout))
    return importlib.import_module("lstm_td3.lstm_td3_main")


def trained(code: Any, seed: int, steps: int, episodes: int) -> dict[str, object]:
    """Train and test one seed."""
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        code.lstm_td3(
            seed=seed,
            steps_per_epoch=steps,
            epochs=1,
            replay_size=steps,
            start_steps=min(RANDOM_STEPS, steps // 2),
            update_after=min(RANDOM_STEPS, steps // 2),
            num_test_episodes=episodes,
            max_ep_len=LIMIT,
            max_hist_len=5,
            critic_hist_with_past_act=True,
            actor_hist_with_past_act=True,
            logger_kwargs={"output_dir": folder},
        )
    return {
        "steps": steps,
        "mean": float(np.mean(Logger.returns)),
        "cpu_seconds": round(time.process_time() - began, 1),
        "torch": torch.__version__,
        "gymnasium": gymnasium.__version__,
    }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkout", type=pathlib.Path, help="a clone of the published code")
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--out", type=pathlib.Path, default=BENCHMARKS / "published_lstm_td3.csv")
    options = parse(parser, arguments)
    if not (options.checkout / "lstm_td3" / "lstm_td3_main.py").is_file():
        parser.error(f"{options.checkout} is not a clone of the published code of LSTM-TD3")
    seeds, steps, episodes = (1, 200, 2) if options.quick else (SEEDS, STEPS, EPISODES)
    torch.set_num_threads(1)
    code = published(options.checkout)
    git = ["git", "-C", str(options.checkout), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    go_through(
        ({"seed": seed} for seed in range(seeds)),
        lambda setting: {**trained(code, setting["seed"], steps, episodes), "commit": commit},
        options.out,
        {"seed": 0},
    )
    means = pd.read_csv(options.out)["mean"]
    print(f"{means.mean():.1f} ± {means.std():.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
