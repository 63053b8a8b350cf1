"""Registers the rover with its disturbances, baselines, ceiling, drawing and stresses."""

import functools
import operator

import jax

from rtd3jax.envs.controllers import PIDPolicy
from rtd3jax.envs.description import Drawing
from rtd3jax.envs.registry import register
from rtd3jax.envs.rover.controllers import constant_command, target_pi
from rtd3jax.envs.rover.environment import Rover, RoverParams, RoverState
from rtd3jax.envs.rover.optimum import best_return
from rtd3jax.envs.rover.slip import WHEELS, Ar1Slip, ConstantSlip, SineSlip
from rtd3jax.envs.stress import Stress
from rtd3jax.protocols import EnvironmentLike


def feedforward_pi(env: EnvironmentLike) -> PIDPolicy | None:
    """Feed-forward of the target, and a PI controller of both errors.

    The result is None if an error is not observed. The gains are the best of a grid under
    ``ar1-slip``, on 1,000 episodes of seed 1000. They are high: if observations are delayed or
    drift, the loop oscillates, and the constant command gives higher returns.
    """
    return target_pi(env, kp=0.1, ki=1.0)


def next_slip(state: RoverState) -> jax.Array | None:
    """The slip [..., 2] that acts in the next step; None if the state does not state it.

    Joined slips act in sequence, so their tractions, one minus the slip, are multiplied. The result
    is None if one of them does not state the slip of both wheels. The state of a `Sum`, which no
    name makes, looks like that of joined slips.
    """
    if type(state.slip) is not tuple:
        return getattr(state.slip, "slip", None)
    slips = [part.slip for part in state.slip if hasattr(part, "slip")]
    whole = len(slips) == len(state.slip) and all(slip.shape[-1] == WHEELS for slip in slips)
    if not slips or not whole:
        return None
    return 1.0 - functools.reduce(operator.mul, [1.0 - slip for slip in slips])


def _constant_slip(params: RoverParams, slip: float) -> RoverParams:
    return params.replace(slip=ConstantSlip(float(slip)))


def _slip_bound(params: RoverParams, bound: float) -> RoverParams:
    """The rover with its own AR(1) slip, or with that of the paper, and another bound."""
    own = params.slip if isinstance(params.slip, Ar1Slip) else Ar1Slip()
    return params.replace(slip=own.replace(max_slip=float(bound)))


_SLIPS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)

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
    baselines={"constant": constant_command, "feedforward-pi": feedforward_pi},
    ceiling=best_return,
    drawing=Drawing(
        observation=("speed error", "yaw-rate error"),
        action=("speed", "yaw rate"),
        kind="rover",
        # The step has no length in seconds; the page assumes 0.1 s.
        constants=("wheelbase", "target_speed", "target_yaw_rate"),
        hidden=next_slip,
        hidden_name="slip",
        hidden_elements=("left", "right"),
    ),
    stresses=(
        Stress("slip", _SLIPS, _constant_slip, "constant slip of both wheels"),
        Stress("slip-bound", _SLIPS, _slip_bound, "largest AR(1) slip"),
    ),
    with_params=Rover,
    try_disturbances=False,  # the tests trace them; the import stays fast
)
