"""The textbook's controller of a pendulum: pump energy until it can be caught, then regulate.

It acts on what it sees as if that were true, without a filter: what a disturbance of the
observation costs such a controller is what a study compares with.
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
    """What is needed where the angular velocity is not seen."""

    time: jax.Array
    """int32 []: observations so far"""
    angle: jax.Array
    """float32 [], rad: the last one seen"""


@struct.dataclass
class SwingUpPolicy:
    """Energy swing-up, and the linear-quadratic regulator near the top; see `swing_up_policy`."""

    params: PendulumParams
    angle_gain: jax.Array
    """N m / rad"""
    velocity_gain: jax.Array
    """N m s / rad"""
    reach: jax.Array
    """the regulator takes over where the torque that it wants is within so many of the limit"""
    velocity_seen: bool = struct.field(pytree_node=False)

    def init(self, key: jax.Array | None = None) -> SwingUpState:
        """Nothing is seen yet."""
        return SwingUpState(jnp.int32(0), jnp.float32(0.0))

    def step(self, state: SwingUpState, observation: jax.Array) -> tuple[jax.Array, SwingUpState]:
        """The torque [1]."""
        params = self.params
        angle = jnp.arctan2(observation[1], observation[0]).astype(jnp.float32)
        if self.velocity_seen:
            velocity = observation[2].astype(jnp.float32)
        else:
            turned = jnp.mod(angle - state.angle + jnp.pi, 2 * jnp.pi) - jnp.pi
            velocity = jnp.where(state.time > 0, turned / params.dt, 0.0)
        # Per moment of inertia, m l^2 / 3; at the top at rest it is ``gravity``.
        gravity = 1.5 * params.g / params.l
        missing = gravity * (1.0 - jnp.cos(angle)) - 0.5 * velocity**2
        # Torque along the motion adds energy; a pendulum at rest is pushed towards the top's side.
        way = jnp.where(velocity >= 0, 1.0, -1.0) * jnp.sign(missing)
        wanted = -(self.angle_gain * angle + self.velocity_gain * velocity)
        caught = jnp.abs(wanted) <= self.reach * params.max_torque
        torque = jnp.where(caught, wanted, way * params.max_torque)
        action = jnp.clip(torque, -params.max_torque, params.max_torque).reshape(1)
        return action.astype(jnp.float32), SwingUpState(state.time + jnp.int32(1), angle)


REACH = 4.0
"""Of 0.5 to 6 the best on the undisturbed pendulum, on episodes of seed 1000."""


def swing_up_policy(env: EnvironmentLike) -> SwingUpPolicy | None:
    """The swing-up of ``env``'s pendulum; None where it does not see the angle.

    Raises:
        UserError: when ``env`` is no pendulum.
    """
    base: Any = env.base if isinstance(env, Disturbed) else env
    if not isinstance(base, Pendulum):
        raise UserError("the swing-up is known for the pendulum alone")
    params = env.default_params
    seen = seen_elements(env, params, 3)
    params = params.env if isinstance(env, Disturbed) else params
    if not {0, 1} <= set(seen):
        return None
    zero = jnp.zeros((), jnp.float32)
    top = PendulumState(theta=zero, theta_dot=zero, last_u=zero, time=jnp.int32(0))
    gain = lqr_policy(base, top, params=params).gain[0]
    return SwingUpPolicy(params, gain[1], gain[2], jnp.float32(REACH), 2 in seen)
