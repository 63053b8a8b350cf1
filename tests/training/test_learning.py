"""That the agents learn: fixed budgets, wide margins."""

import rtd3jax as rtd


def test_td3_swings_up_the_fully_observable_pendulum():
    config = rtd.Config(algorithm="td3", total_steps=15_000, eval_every=5_000)
    run = rtd.train(rtd.make("pendulum"), config, [0, 1], progress=False)
    assert run.returns[:, -1].mean() > -250


def test_a_recurrent_agent_compensates_wheel_slip():
    env = rtd.make("rover", disturbance="ar1-slip")
    config = rtd.Config(
        algorithm="lstm-td3-1ha1hc",
        history_length=2,
        total_steps=10_000,
        hidden_size=64,
        eval_every=5_000,
        eval_episodes=20,
    )
    run = rtd.train(env, config, [0, 1], progress=False)
    assert run.returns[:, -1].mean() > -2.6
