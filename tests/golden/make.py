"""Writes the files of this folder, which later versions must go on reading.

Commit 6d75fe8 wrote them, before agents acted in half ranges (files of format 1):

    git worktree add /tmp/old 6d75fe8 && cd /tmp/old
    python -m pip install -e . && python <this file> OUT

Made again by a later version, they would prove nothing.
"""

import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import spaces

import rtd3jax as rtd

EPISODE, LENGTH, WIDTH = 8, 3, 8
AGENTS = (
    "td3",
    "lstm-td3",
    "lstm-td3-no-action",
    "lstm-td3-1ha1hc",
    "lstm-td3-1ha2hc",
    "h-td3",
)


def environments():
    """The pendulum (actions within 2), the rover (within 1), and one whose range is not about 0."""
    pendulum, rover = rtd.make("pendulum", "random-sine"), rtd.make("rover", "ar1-slip")
    shifted = rtd.make("pendulum")
    shifted.action_space = lambda params=None: spaces.Box(1.0, 4.0, (1,), jnp.float32)
    return {"pendulum": pendulum, "rover": rover, "shifted": shifted}


def main(out: pathlib.Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    expected = {}
    for environment, env in environments().items():
        for agent in AGENTS:
            config = rtd.Config(
                algorithm=agent,
                history_length=None if agent == "td3" else LENGTH,
                total_steps=60,
                hidden_size=WIDTH,
                batch_size=8,
                learning_starts=20,
                eval_every=60,
                eval_episodes=1,
                actor_learning_rate=3e-3,
            )
            policy = rtd.train(env, config, seeds=[0], progress=False).policy(0)
            policy.save(out / f"{environment}-{agent}.safetensors", overwrite=True)
            size = policy.observation_size
            seen = np.random.default_rng(0).normal(size=(EPISODE, size)).astype(np.float32)
            state, actions = policy.init(), []
            for observation in seen:
                action, state = jax.jit(policy.step)(state, observation)
                actions.append(np.asarray(action))
            expected[f"{environment}-{agent}.observations"] = seen
            expected[f"{environment}-{agent}.actions"] = np.stack(actions)
    np.savez(out / "actions.npz", **expected)
    flags = [
        *("--env", "pendulum", "--disturbances", "random-sine", "--seeds", "2"),
        *("--algorithms", "td3", "lstm-td3-1ha1hc", "--history-lengths", "2", "--hidden-size", "4"),
        *("--batch-size", "4", "--learning-starts", "10", "--total-steps", "40"),
        *("--eval-every", "20", "--eval-episodes", "2", "--final-episodes", "3"),
        *("--out", str(out / "run"), "--no-report", "--quiet"),
    ]
    subprocess.run([sys.executable, "-m", "rtd3jax.sweep", *flags], check=True)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
