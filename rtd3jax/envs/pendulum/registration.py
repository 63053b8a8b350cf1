"""Registers the pendulum with its disturbances, baseline, ceiling and drawing."""

from rtd3jax.envs.description import Drawing
from rtd3jax.envs.pendulum.environment import Pendulum
from rtd3jax.envs.pendulum.optimum import best_return
from rtd3jax.envs.pendulum.swing_up import swing_up_policy
from rtd3jax.envs.processes.disturbances import DampedSine, GaussianNoise, Hidden, Pulses, Sine
from rtd3jax.envs.registry import register

register(
    "pendulum",
    Pendulum(),
    {
        "temporal-bias": Pulses(),
        "temporal-sine": Sine(
            amplitude_min=1.0,
            amplitude_max=1.0,
            period_min=70.0,
            period_max=70.0,
            elements=(0, 1),
        ),
        "random-sine": Sine(),
        "noise": GaussianNoise(),
        "hidden": Hidden(),
        "combined-sine": Sine(waves=2),
        "damped-sine": DampedSine(),
    },
    positive=("max_speed", "max_torque", "dt", "m", "l"),
    reward_from_observation=("noise",),
    baselines={"swing-up": swing_up_policy},
    ceiling=best_return,
    drawing=Drawing(
        observation=("cos θ", "sin θ", "angular velocity"),
        action=("torque",),
        kind="pendulum",
        constants=("max_torque",),
        step_seconds="dt",
    ),
    try_disturbances=False,  # the tests trace them; the import stays fast
)
