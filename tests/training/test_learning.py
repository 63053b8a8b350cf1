"""That the agents learn: fixed budgets, wide margins."""

import rtd3jax as rtd
from rtd3jax.study.presets import PRESETS


def test_td3_swings_up_the_fully_observable_pendulum():
    config = rtd.Config(algorithm="td3", total_steps=15_000, eval_every=5_000)
    run = rtd.train(rtd.make("pendulum"), config, [0, 1], progress=False)
    assert run.returns[:, -1].mean() > -250


def test_a_recurrent_agent_compensates_wheel_slip():
    env = rtd.make("rover", disturbance="ar1-slip")
    config = rtd.Config(
        algorithm="lstm-td3-1ha1hc",
        **{
            **PRESETS["quick"][0].settings,
            "history_length": 1,
            "total_steps": 8_000,
            "eval_every": 8_000,
            "eval_episodes": 20,
        },
    )
    run = rtd.train(env, config, [0, 1], progress=False)
    assert run.returns[:, -1].mean() > -2.2
