"""Controllers of a rover on soil that need no training."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.envs.controllers import PIDPolicy
from rtd3jax.envs.interface import describe
from rtd3jax.envs.processes.process import float32
from rtd3jax.envs.rover.controllers import plain_params, target_pi
from rtd3jax.envs.rover.task import sides
from rtd3jax.protocols import EnvironmentLike


def feedforward_pi(env: EnvironmentLike) -> PIDPolicy | None:
    """Feed-forward of the target, and a PI controller of both errors.

    The result is None if an error is not observed. The gains differ from those of the rover without
    soil: they are the best of a grid, on 1,000 episodes of seed 1000
    (experiments/rover_soil_gains.py).
    """
    return target_pi(env, *PI_GAINS)


PI_GAINS = (0.0, 1.6)
"""(kp, ki)"""
ESTIMATE_GAIN = 1.0
"""Weight of each new measurement in the estimate of the slip; from the search of ``PI_GAINS``."""
LARGEST_SLIP = 0.8
"""Largest estimate of the slip, which limits the command."""


class AdaptiveState(NamedTuple):
    """The state of an `AdaptivePolicy`.

    Attributes:
        command: float32 [2], the last commanded rim speeds, m/s.
        slip: float32 [2], the estimated slip.
        time: int32 [], number of steps so far.
    """

    command: jax.Array
    slip: jax.Array
    time: jax.Array


@struct.dataclass
class AdaptivePolicy:
    """Estimates the slip of each wheel, and increases the command to compensate for it.

    The measured slip is ``1 - hub / rim``, from the observed motion and the last commanded rim
    speeds. The estimate is a moving average of the measurements, with weight ``gain``. The next
    command is the target's wheel speeds divided by ``1 - estimate``, within the rover's limits.
    """

    wheelbase: jax.Array
    target_speed: jax.Array
    target_yaw_rate: jax.Array
    max_speed: jax.Array
    max_yaw_rate: jax.Array
    gain: jax.Array

    def init(self, key: jax.Array | None = None) -> AdaptiveState:
        """The state before the first step, with zero slip; ``key`` is not used."""
        zeros = jnp.zeros((2,), jnp.float32)
        return AdaptiveState(zeros, zeros, jnp.int32(0))

    def step(self, state: AdaptiveState, observation: jax.Array) -> tuple[jax.Array, AdaptiveState]:
        """The command [2], m/s and rad/s, and the next state."""
        hub = sides(
            observation[0] + self.target_speed,
            observation[1] + self.target_yaw_rate,
            self.wheelbase,
        )
        moved = jnp.abs(state.command) > 0.05
        read = 1.0 - hub / jnp.where(moved, state.command, 1.0)
        read = jnp.where(moved, jnp.clip(read, -LARGEST_SLIP, LARGEST_SLIP), state.slip)
        # The first measurement is ignored: the rover has accelerated from rest.
        known = state.time > 1
        slip = jnp.where(known, state.slip + self.gain * (read - state.slip), state.slip)
        slip = jnp.clip(slip, 0.0, LARGEST_SLIP)
        wanted = sides(self.target_speed, self.target_yaw_rate, self.wheelbase)
        left, right = wanted / (1.0 - slip)
        speed = jnp.clip(0.5 * (left + right), -self.max_speed, self.max_speed)
        yaw_rate = (right - left) / self.wheelbase
        yaw_rate = jnp.clip(yaw_rate, -self.max_yaw_rate, self.max_yaw_rate)
        # The slip is measured against the command that the rover follows: against a larger one, the
        # estimate would only grow.
        command = sides(speed, yaw_rate, self.wheelbase)
        action = jnp.stack([speed, yaw_rate])
        return action, AdaptiveState(command, slip, state.time + jnp.int32(1))


def adaptive_slip(env: EnvironmentLike, gain: float = ESTIMATE_GAIN) -> AdaptivePolicy | None:
    """The `AdaptivePolicy` for ``env``; None if an error is not observed."""
    if describe(env, env.default_params).observation_size != 2:
        return None
    params = plain_params(env)
    return AdaptivePolicy(
        wheelbase=float32(params.wheelbase),
        target_speed=float32(params.target_speed),
        target_yaw_rate=float32(params.target_yaw_rate),
        max_speed=float32(params.max_speed),
        max_yaw_rate=float32(params.max_yaw_rate),
        gain=float32(gain),
    )
