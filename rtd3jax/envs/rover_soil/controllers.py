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
    """The target fed forward, and a PI controller of both errors; None where one is not seen.

    The rover's (`rtd3jax.envs.rover.registration`) with other gains: those of
    experiments/rover_soil_gains.py, the best of a grid on 1,000 episodes of seed 1000.
    """
    return target_pi(env, *PI_GAINS)


PI_GAINS = (0.0, 1.6)
"""(kp, ki)"""
ESTIMATE_GAIN = 1.0
"""Share of each new reading of the slip in the estimate; from the same search as ``PI_GAINS``."""
LARGEST_SLIP = 0.8
"""Of the estimate: beyond it no command within the bounds helps."""


class AdaptiveState(NamedTuple):
    """What the controller remembers.

    Attributes:
        command: float32 [2], rim speeds that it last commanded, m/s.
        slip: float32 [2], its estimate.
        time: int32 [], steps done.
    """

    command: jax.Array
    slip: jax.Array
    time: jax.Array


@struct.dataclass
class AdaptivePolicy:
    """Estimate each wheel's slip, and command what it leaves of the target.

    The slip that the last command met is ``1 - hub / rim``, from the motion that was observed; the
    estimate is its moving average with ``gain``, and the next command the target's wheel speeds
    over ``1 - estimate``.
    """

    wheelbase: jax.Array
    target_speed: jax.Array
    target_yaw_rate: jax.Array
    gain: jax.Array

    def init(self, key: jax.Array | None = None) -> AdaptiveState:
        """No slip is known yet; ``key`` is not needed."""
        zeros = jnp.zeros((2,), jnp.float32)
        return AdaptiveState(zeros, zeros, jnp.int32(0))

    def step(self, state: AdaptiveState, observation: jax.Array) -> tuple[jax.Array, AdaptiveState]:
        """The command [2]."""
        hub = sides(
            observation[0] + self.target_speed,
            observation[1] + self.target_yaw_rate,
            self.wheelbase,
        )
        moved = jnp.abs(state.command) > 0.05
        read = 1.0 - hub / jnp.where(moved, state.command, 1.0)
        read = jnp.where(moved, jnp.clip(read, -LARGEST_SLIP, LARGEST_SLIP), state.slip)
        # The first reading of an episode is that of a start from rest.
        known = state.time > 1
        slip = jnp.where(known, state.slip + self.gain * (read - state.slip), state.slip)
        slip = jnp.clip(slip, 0.0, LARGEST_SLIP)
        wanted = sides(self.target_speed, self.target_yaw_rate, self.wheelbase)
        command = wanted / (1.0 - slip)
        speed = 0.5 * (command[0] + command[1])
        action = jnp.stack([speed, (command[1] - command[0]) / self.wheelbase])
        return action, AdaptiveState(command, slip, state.time + jnp.int32(1))


def adaptive_slip(env: EnvironmentLike, gain: float = ESTIMATE_GAIN) -> AdaptivePolicy | None:
    """The `AdaptivePolicy` of ``env``; None where an error is not seen."""
    if describe(env, env.default_params).observation_size != 2:
        return None
    params = plain_params(env)
    return AdaptivePolicy(
        wheelbase=float32(params.wheelbase),
        target_speed=float32(params.target_speed),
        target_yaw_rate=float32(params.target_yaw_rate),
        gain=float32(gain),
    )
