"""Registers the rover on soil with its grounds, baselines and drawing."""

import jax

from rtd3jax.envs.description import Drawing
from rtd3jax.envs.registry import register
from rtd3jax.envs.rover.controllers import constant_command
from rtd3jax.envs.rover_soil.controllers import adaptive_slip, feedforward_pi
from rtd3jax.envs.rover_soil.environment import RoverSoil, RoverSoilState
from rtd3jax.envs.rover_soil.field import Ground
from rtd3jax.envs.rover_soil.soil import DRY_SAND, REGOLITH

GROUNDS = {
    "dry-sand": Ground(DRY_SAND, DRY_SAND),
    "dry-sand-slope": Ground(DRY_SAND, DRY_SAND, slope=2.0),
    "regolith": Ground(REGOLITH, REGOLITH),
    "regolith-slope": Ground(REGOLITH, REGOLITH, slope=5.0),
    "mixed": Ground(DRY_SAND, REGOLITH),
    "mixed-slope": Ground(DRY_SAND, REGOLITH, slope=2.0),
}
"""Each ground without and with a slope. The standard deviation of the slope, in degrees, is one
that a wheel can climb on this soil [choice]."""


def met_slip(state: RoverSoilState) -> jax.Array:
    """The slip of the wheels [..., 2] at the end of the last step.

    The soil then determines how the slip changes during the next step.
    """
    return state.slip


register(
    "rover-soil",
    RoverSoil(),
    {name: ("ground", ground) for name, ground in GROUNDS.items()},
    positive=(
        *("wheelbase", "max_speed", "max_yaw_rate", "step_seconds", "mass", "yaw_inertia"),
        *("gravity", "wheel_radius", "wheel_width", "wheel_inertia", "motor_gain", "motor_torque"),
    ),
    baselines={
        "constant": constant_command,
        "feedforward-pi": feedforward_pi,
        "adaptive-slip": adaptive_slip,
    },
    drawing=Drawing(
        observation=("speed error", "yaw-rate error"),
        action=("speed", "yaw rate"),
        kind="rover",
        constants=("wheelbase", "target_speed", "target_yaw_rate"),
        step_seconds="step_seconds",
        hidden=met_slip,
        hidden_name="slip",
        hidden_elements=("left", "right"),
    ),
    with_params=RoverSoil,
    try_disturbances=False,  # the tests trace them; the import stays fast
)
