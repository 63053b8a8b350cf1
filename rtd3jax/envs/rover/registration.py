"""The rover by name: disturbances, baseline, ceiling and drawing."""

from typing import Any

import jax

from rtd3jax.envs.about import Drawing
from rtd3jax.envs.registry import register
from rtd3jax.envs.rover.environment import Rover, RoverState
from rtd3jax.envs.rover.optimum import best_return
from rtd3jax.envs.rover.slip import Ar1Slip, SineSlip
from rtd3jax.protocols import EnvironmentLike


def constant_command(env: EnvironmentLike) -> tuple[Any, Any]:
    """The target itself, which a rover without slip would hold; ``env`` may have faults."""
    params = env.default_params
    params = getattr(params, "env", params)
    return params.target_speed, params.target_yaw_rate


def met_slip(state: RoverState) -> jax.Array | None:
    """The slip [..., 2] that the next command meets; None where there is none."""
    parts = state.slip if type(state.slip) is tuple else (state.slip,)
    return next((part.slip for part in parts if hasattr(part, "slip")), None)


register(
    "rover",
    Rover(),
    {
        "ar1-slip": ("slip", Ar1Slip()),
        "ar1-slip-high-variance": ("slip", Ar1Slip(sigma=0.10)),
        "ar1-slip-fast": ("slip", Ar1Slip(rho=0.90)),
        "ar1-slip-slow": ("slip", Ar1Slip(rho=0.98)),
        "sine-slip": ("slip", SineSlip()),
    },
    positive=("wheelbase", "max_speed", "max_yaw_rate"),
    baselines={"constant": constant_command},
    ceiling=best_return,
    drawing=Drawing(
        observation=("speed error", "yaw-rate error"),
        action=("speed", "yaw rate"),
        kind="rover",
        # The step has no length in seconds; the page says what it draws.
        constants=("wheelbase", "target_speed", "target_yaw_rate"),
        hidden=met_slip,
        hidden_name="slip",
        hidden_elements=("left", "right"),
    ),
    with_params=Rover,
    try_disturbances=False,  # the tests do, and an import stays quick
)
