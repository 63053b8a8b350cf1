"""gymnax's pendulum (paper, Section 5.2), with the reward as a function of an observation.

Units: rad, rad/s, N m. A step takes 0.05 s; the torque is limited to 2, the speed to 8; an
episode has 200 steps and never terminates.
The observation [3] is (cos theta, sin theta, theta dot).
"""

import jax
import jax.numpy as jnp
from gymnax.environments.classic_control import pendulum
from gymnax.environments.classic_control.pendulum import EnvParams as PendulumParams
from gymnax.environments.classic_control.pendulum import EnvState as PendulumState

from rtd3jax.envs.identity import ValueIdentity, strong
from rtd3jax.envs.pendulum.scene import PendulumScene
from rtd3jax.envs.processes.process import float32

__all__ = ["Pendulum", "PendulumParams", "PendulumState"]


class Pendulum(ValueIdentity, pendulum.Pendulum):
    """gymnax's dynamics and reward, unchanged."""

    def reset_env(self, key: jax.Array, params: PendulumParams) -> tuple[jax.Array, PendulumState]:
        """Draw the start: theta from U(-pi, pi), theta dot from U(-1, 1)."""
        observation, state = super().reset_env(key, params)
        return observation, strong(state)

    def observed_reward(
        self, observation: jax.Array, action: jax.Array, params: PendulumParams
    ) -> jax.Array:
        """The reward [] of ``action`` [1], computed as if ``observation`` [3] were the true state.

        The reward is ``-(theta^2 + 0.1 thetadot^2 + 0.001 u^2)``, where theta is the direction of
        the observed (cos, sin); a disturbed vector need not have length one.
        """
        theta = jnp.arctan2(observation[1], observation[0])
        limit = float32(params.max_torque)
        torque = jnp.clip(jnp.asarray(action, jnp.float32).reshape(()), -limit, limit)
        return -(theta**2 + 0.1 * observation[2] ** 2 + 0.001 * torque**2)

    def scene(self, params: PendulumParams) -> PendulumScene:
        """The drawing for the frames of an episode."""
        return PendulumScene(params)
