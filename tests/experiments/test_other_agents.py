"""Tests the scripts that train the agents of other packages, with stand-ins for what is missing."""

import importlib
import subprocess
import sys
import types

import gymnasium
import numpy as np
import pandas as pd
import pytest

# It asks what the scripts ask: the imports that are replaced, the arguments, old gym's interface.
PUBLISHED = """
import gym
import pybullet_envs
from lstm_td3.utils.logx import EpochLogger, setup_logger_kwargs, colorize
from lstm_td3.env_wrapper.env import make_bullet_task

class Wrapped(gym.ObservationWrapper):
    pass

def lstm_td3(seed, steps_per_epoch, epochs, replay_size, start_steps, update_after,
             num_test_episodes, max_ep_len, max_hist_len, critic_hist_with_past_act,
             actor_hist_with_past_act, logger_kwargs):
    assert (start_steps, update_after, max_hist_len) == (100, 100, 5)
    assert critic_hist_with_past_act and actor_hist_with_past_act
    logger = EpochLogger(**logger_kwargs)
    logger.save_config({})
    env, test_env = make_bullet_task("pendulum"), make_bullet_task("pendulum")
    for each in (env, test_env):
        each.seed(seed)
    observation = env.reset()
    for _ in range(epochs * steps_per_epoch):
        assert observation.shape == env.observation_space.shape == (2,)
        observation, reward, done, _ = env.step(env.action_space.sample())
        logger.store(QVals=0.0)
        if done:
            observation = env.reset()
    for _ in range(num_test_episodes):
        test_env.reset()
        total, done, steps = 0.0, False, 0
        while not (done or steps == max_ep_len):
            _, reward, done, _ = test_env.step(test_env.action_space.sample())
            total, steps = total + reward, steps + 1
        logger.store(TestEpRet=total)
"""


class Falling(gymnasium.Env):
    """Position, angle and their velocities; it falls after seven steps, with a reward of one."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64)

    def __init__(self):
        self.action_space = gymnasium.spaces.Box(-3.0, 3.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._steps = 0
        return self.np_random.normal(size=4), {}

    def step(self, action):
        self._steps += 1
        return self.np_random.normal(size=4), 1.0, self._steps == 7, False, {}


@pytest.fixture
def falling(monkeypatch):
    monkeypatch.setattr(gymnasium, "make", lambda name: Falling())


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A clone that holds a module with the published one's interface; and no torch is needed."""
    module = tmp_path / "clone" / "lstm_td3" / "lstm_td3_main.py"
    module.parent.mkdir(parents=True)
    module.write_text(PUBLISHED)
    git = ["git", "-C", str(module.parents[1]), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "its code"]):
        subprocess.run([*git, *command], check=True)
    torch = types.SimpleNamespace(set_num_threads=lambda count: None, __version__="2.0")
    kept, path = dict(sys.modules), list(sys.path)
    sys.modules["torch"] = torch
    yield module.parents[1]
    for name in set(sys.modules) - set(kept):
        if name.split(".")[0] in {"gym", "pybullet_envs", "lstm_td3", "torch"}:
            del sys.modules[name]
    sys.modules.update(kept)
    sys.path[:] = path


def test_the_published_lstm_td3_quick(checkout, falling, tmp_path, capsys):
    script = importlib.import_module("experiments.benchmarks.published_lstm_td3")
    out = tmp_path / "published.csv"
    for _ in range(2):  # the second time, the seed has its row
        assert script.main([str(checkout), "--quick", "--out", str(out)]) == 0
        (row,) = pd.read_csv(out).to_dict("records")
        assert (row["seed"], row["steps"], row["mean"]) == (0, 200, 7.0) and row["commit"]
    assert "7.0" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        script.main([str(tmp_path), "--quick", "--out", str(out)])
    assert "is not a clone of the published code" in capsys.readouterr().err


def test_recurrent_ppo_quick(falling, tmp_path):
    pytest.importorskip("sb3_contrib", reason="sb3-contrib is not installed")
    script = importlib.import_module("experiments.benchmarks.recurrent_ppo")
    out = tmp_path / "ppo.csv"
    assert script.main(["--quick", "--out", str(out)]) == 0
    (row,) = pd.read_csv(out).to_dict("records")
    assert row["steps"] >= 128 and row["mean"] == 7.0
