"""That the agents learn: fixed budgets, wide margins.

Each trains in a process of its own, compiled as it is for users: here the time is the training's.
"""

import os
import subprocess
import sys

import pytest
from compiling import as_for_users


def final_return(code):
    """The mean return at the end of the two lanes of ``run``, which ``code`` trains."""
    done = subprocess.run(
        [sys.executable, "-c", f"import rtd3jax as rtd\n{code}\nprint(run.returns[:, -1].mean())"],
        env={**os.environ, "XLA_FLAGS": as_for_users(os.environ.get("XLA_FLAGS", ""))},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return float(done.stdout)


@pytest.mark.slow
def test_td3_swings_up_the_fully_observable_pendulum():
    code = """
config = rtd.Config(algorithm="td3", total_steps=15_000, eval_every=5_000)
run = rtd.train(rtd.make("pendulum"), config, [0, 1], progress=False)
"""
    assert final_return(code) > -250


def test_a_recurrent_agent_compensates_wheel_slip():
    code = """
from rtd3jax.study.presets import PRESETS
settings = dict(PRESETS["quick"][0].settings, total_steps=8_000, eval_every=8_000)
settings |= dict(algorithm="lstm-td3-1ha1hc", history_length=1, eval_episodes=20)
config = rtd.Config(**settings)
run = rtd.train(rtd.make("rover", "ar1-slip"), config, [0, 1], progress=False)
"""
    assert final_return(code) > -2.2
