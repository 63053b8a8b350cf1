"""A classical controller of a pendulum: energy-based swing-up, then a linear regulator.

The controller treats the observation as the true state and has no filter. A study compares trained
agents with the return of this controller under the same disturbance.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.envs.controllers import lqr_policy
from rtd3jax.envs.disturbed import Disturbed, seen_elements
from rtd3jax.envs.pendulum.environment import Pendulum, PendulumParams, PendulumState
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike


class SwingUpState(struct.PyTreeNode):
    """State of the controller, which it needs if the angular velocity is not observed."""

    time: jax.Array
    """int32 []: number of observations so far"""
    angle: jax.Array
    """float32 [], rad: the last observed angle"""


@struct.dataclass
class SwingUpPolicy:
    """Energy swing-up, and the linear-quadratic regulator near the top; see `swing_up_policy`."""

    params: PendulumParams
    angle_gain: jax.Array
    """N m / rad"""
    velocity_gain: jax.Array
    """N m s / rad"""
    reach: jax.Array
    """the regulator acts if its torque is at most this multiple of the torque limit"""
    velocity_seen: bool = struct.field(pytree_node=False)

    def init(self, key: jax.Array | None = None) -> SwingUpState:
        """The state before the first observation of an episode."""
        return SwingUpState(jnp.int32(0), jnp.float32(0.0))

    def step(self, state: SwingUpState, observation: jax.Array) -> tuple[jax.Array, SwingUpState]:
        """The torque [1], and the next state."""
        params = self.params
        angle = jnp.arctan2(observation[1], observation[0]).astype(jnp.float32)
        if self.velocity_seen:
            velocity = observation[2].astype(jnp.float32)
        else:
            turned = jnp.mod(angle - state.angle + jnp.pi, 2 * jnp.pi) - jnp.pi
            velocity = jnp.where(state.time > 0, turned / params.dt, 0.0)
        # Energy divided by the moment of inertia m l^2 / 3; at rest at the top it is ``gravity``.
        gravity = 1.5 * params.g / params.l
        missing = gravity * (1.0 - jnp.cos(angle)) - 0.5 * velocity**2
        # Torque along the motion adds energy; at rest, the torque points towards the top.
        way = jnp.where(velocity >= 0, 1.0, -1.0) * jnp.sign(missing)
        wanted = -(self.angle_gain * angle + self.velocity_gain * velocity)
        caught = jnp.abs(wanted) <= self.reach * params.max_torque
        torque = jnp.where(caught, wanted, way * params.max_torque)
        action = jnp.clip(torque, -params.max_torque, params.max_torque).reshape(1)
        return action.astype(jnp.float32), SwingUpState(state.time + jnp.int32(1), angle)


REACH = 4.0
"""The best value from 0.5 to 6 on the undisturbed pendulum, on episodes of seed 1000."""


def swing_up_policy(env: EnvironmentLike) -> SwingUpPolicy | None:
    """The swing-up controller for ``env``; None if the angle is not observed.

    Raises:
        UserError: when ``env`` is not a pendulum.
    """
    base: Any = env.base if isinstance(env, Disturbed) else env
    if not isinstance(base, Pendulum):
        raise UserError("the swing-up controller is only known for the pendulum")
    params = env.default_params
    seen = seen_elements(env, params, 3)
    params = params.env if isinstance(env, Disturbed) else params
    if not {0, 1} <= set(seen):
        return None
    zero = jnp.zeros((), jnp.float32)
    top = PendulumState(theta=zero, theta_dot=zero, last_u=zero, time=jnp.int32(0))
    gain = lqr_policy(base, top, params=params).gain[0]
    return SwingUpPolicy(params, gain[1], gain[2], jnp.float32(REACH), 2 in seen)
