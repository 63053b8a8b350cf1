"""The task of every rover: hold a speed and a yaw rate (paper, Section 8.2).

Units: m, s, rad. The left wheel comes first. All rovers inherit from `DrivingTask`, so a policy of
one rover can act in another.
"""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from gymnax.environments import environment, spaces

from rtd3jax.envs.identity import ValueIdentity, strong
from rtd3jax.envs.processes.process import float32


class TaskParams(Protocol):
    """The parameters of a rover that the task reads."""

    target_speed: float
    target_yaw_rate: float
    max_speed: float
    max_yaw_rate: float


class MotionState(Protocol):
    """The part of a rover's state that the task reads."""

    speed: jax.Array
    yaw_rate: jax.Array


class DrivingTask(ValueIdentity, environment.Environment):
    """Task: hold a speed and a yaw rate. Actions [2] command them; observations [2] are errors."""

    # Steps stop gradients, except those of gymnax's `with_transition_gradients`, for the LQR.
    _supports_transition_gradients = True

    def outcome(self, evolved: Any, params: Any) -> tuple[Any, Any, jax.Array, jax.Array, dict]:
        """The values that ``step_env`` returns; ``evolved`` is the state after the step.

        The reward [] is the negative squared error of the motion in this state.
        """
        observation = errors(evolved, params)
        reward = -jnp.sum(observation**2)
        observation, evolved = self._apply_transition_gradient_policy(observation, strong(evolved))
        terminated = self.is_terminated(evolved, params)
        return observation, evolved, reward, terminated, {"true_reward": reward}

    def is_terminated(self, state: object, params: object) -> jax.Array:
        """Always false: only the time limit ends an episode."""
        return jnp.zeros((), jnp.bool_)

    @property
    def num_actions(self) -> int:
        """Elements of an action."""
        return 2

    def action_space(self, params: TaskParams | None = None) -> spaces.Box:
        """Bounds of (speed m/s, yaw rate rad/s)."""
        limit = limits(self.default_params if params is None else params)
        return spaces.Box(-limit, limit, (2,), jnp.float32)

    def observation_space(self, params: TaskParams | None = None) -> spaces.Box:
        """(speed error m/s, yaw-rate error rad/s), unbounded."""
        return spaces.Box(-jnp.inf, jnp.inf, (2,), jnp.float32)


def limits(params: TaskParams) -> jax.Array:
    """Largest command [2]: m/s, rad/s."""
    return jnp.stack([float32(params.max_speed), float32(params.max_yaw_rate)])


def sides(speed: jax.Array, yaw_rate: jax.Array, wheelbase: jax.Array) -> jax.Array:
    """Speeds of the left and right side [2], m/s."""
    turn = 0.5 * wheelbase * yaw_rate
    return jnp.stack([speed - turn, speed + turn])


def errors(state: MotionState, params: TaskParams) -> jax.Array:
    """Observation [2]: motion minus target, m/s and rad/s."""
    return jnp.stack(
        [
            state.speed - float32(params.target_speed),
            state.yaw_rate - float32(params.target_yaw_rate),
        ]
    )
