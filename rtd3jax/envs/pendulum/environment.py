"""gymnax's pendulum (paper, Section 5.2), with the reward as a function of an observation.

Units: rad, rad/s, N m. A step takes 0.05 s; the torque is limited to 2, the speed to 8; an
episode has 200 steps and never terminates.
The observation [3] is (cos theta, sin theta, theta dot).
"""

from typing import Any

import jax
import jax.numpy as jnp
from gymnax.environments.classic_control import pendulum
from gymnax.environments.classic_control.pendulum import EnvParams as PendulumParams
from gymnax.environments.classic_control.pendulum import EnvState as PendulumState
from jax.typing import ArrayLike

from rtd3jax.envs.identity import ValueIdentity
from rtd3jax.envs.pendulum.scene import PendulumScene
from rtd3jax.envs.processes.process import float32

__all__ = ["Pendulum", "PendulumParams", "PendulumState"]


class Pendulum(ValueIdentity, pendulum.Pendulum):
    """gymnax's dynamics and reward, unchanged, in float32 also under JAX_ENABLE_X64.

    With gymnax's own code, a state would begin in float64 there and continue in float32, and JAX's
    loops refuse such a change.
    """

    def reset_env(self, key: jax.Array, params: PendulumParams) -> tuple[jax.Array, PendulumState]:
        """Draw the start: theta from U(-pi, pi), theta dot from U(-1, 1)."""
        high = jnp.array([jnp.pi, 1.0], jnp.float32)
        theta, theta_dot = jax.random.uniform(key, (2,), jnp.float32, -high, high)
        state = PendulumState(
            time=jnp.int32(0), last_u=jnp.float32(0.0), theta=theta, theta_dot=theta_dot
        )
        return self.get_obs(state), state

    def step_env(
        self, key: jax.Array, state: PendulumState, action: ArrayLike, params: PendulumParams
    ) -> tuple[jax.Array, PendulumState, jax.Array, jax.Array, dict[Any, Any]]:
        """One step under ``action`` [1]."""
        action = jnp.asarray(action, jnp.float32)
        observation, after, reward, terminated, info = super().step_env(key, state, action, params)
        evolved = PendulumState(
            time=jnp.asarray(after.time, jnp.int32),
            last_u=after.last_u.astype(jnp.float32),
            theta=after.theta.astype(jnp.float32),
            theta_dot=after.theta_dot.astype(jnp.float32),
        )
        return (
            observation.astype(jnp.float32),
            evolved,
            reward.astype(jnp.float32),
            terminated,
            info,
        )

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
