"""A differential-drive rover with wheel slip (paper, Section 8.2).

Units: m, s, rad. The left wheel comes first. The motion has no inertia: each command sets the wheel
speeds of its own step. The only hidden variable is the slip, which acts inside the dynamics.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces
from jax.typing import ArrayLike

from rtd3jax.envs.identity import ValueIdentity, strong
from rtd3jax.envs.processes.process import NoDisturbance, Process, float32
from rtd3jax.envs.rover.scene import RoverScene
from rtd3jax.envs.rover.slip import WHEELS


class RoverParams(struct.PyTreeNode):
    """The rover, its task and its slip."""

    max_steps_in_episode: int = 200
    wheelbase: float = 0.5
    """m"""
    target_speed: float = 0.5
    """m/s"""
    target_yaw_rate: float = 0.0
    """rad/s"""
    slip: Process = NoDisturbance()
    max_speed: float = 1.0
    """m/s, bound of the speed command [choice]: enough to hold the target at a slip of up to 0.5"""
    max_yaw_rate: float = 1.0
    """rad/s, bound of the yaw-rate command [choice]: enough at a slip of up to 0.5"""


class RoverState(struct.PyTreeNode):
    """The state of one episode."""

    time: jax.Array
    """int32 []: steps taken"""
    speed: jax.Array
    """float32 [], m/s"""
    yaw_rate: jax.Array
    """float32 [], rad/s"""
    slip: Any
    """state of the slip process"""


class Rover(ValueIdentity, environment.Environment):
    """Task: hold a speed and a yaw rate. Actions [2] command them; observations [2] are errors."""

    def __init__(self, default_params: RoverParams | None = None) -> None:
        super().__init__()
        self._default_params = default_params

    @property
    def default_params(self) -> RoverParams:
        """The parameters given at construction; by default a rover without slip."""
        return RoverParams() if self._default_params is None else self._default_params

    def reset_env(self, key: jax.Array, params: RoverParams) -> tuple[jax.Array, RoverState]:
        """Start an episode at rest."""
        state = RoverState(
            time=jnp.zeros((), jnp.int32),
            speed=jnp.zeros((), jnp.float32),
            yaw_rate=jnp.zeros((), jnp.float32),
            slip=params.slip.init(key, params.max_steps_in_episode, WHEELS),
        )
        return _errors(state, params), strong(state)

    def step_env(
        self, key: jax.Array, state: RoverState, action: ArrayLike, params: RoverParams
    ) -> tuple[jax.Array, RoverState, jax.Array, jax.Array, dict[Any, Any]]:
        """Command ``action`` [2]; the reward [] belongs to the resulting motion."""
        limit = _limits(params)
        command = jnp.clip(jnp.asarray(action, jnp.float32), -limit, limit)
        wheelbase = float32(params.wheelbase)
        turn = 0.5 * wheelbase * command[1]
        nominal = jnp.stack([command[0] - turn, command[0] + turn])
        realised, slip = params.slip.step(key, state.slip, nominal)
        evolved = RoverState(
            time=state.time + 1,
            speed=0.5 * (realised[0] + realised[1]),
            yaw_rate=(realised[1] - realised[0]) / wheelbase,
            slip=slip,
        )
        observation = _errors(evolved, params)
        reward = -jnp.sum(observation**2)
        observation, evolved = self._apply_transition_gradient_policy(observation, strong(evolved))
        terminated = self.is_terminated(evolved, params)
        return observation, evolved, reward, terminated, {"true_reward": reward}

    def is_terminated(self, state: RoverState, params: RoverParams) -> jax.Array:
        """Always false: only the time limit ends an episode."""
        return jnp.zeros((), jnp.bool_)

    def scene(self, params: RoverParams) -> RoverScene:
        """The drawing for the frames of an episode."""
        return RoverScene(params)

    @property
    def name(self) -> str:
        """The name used in messages."""
        return "rover"

    @property
    def num_actions(self) -> int:
        """Elements of an action."""
        return 2

    def action_space(self, params: RoverParams | None = None) -> spaces.Box:
        """Bounds of (speed m/s, yaw rate rad/s)."""
        limit = _limits(self.default_params if params is None else params)
        return spaces.Box(-limit, limit, (2,), jnp.float32)

    def observation_space(self, params: RoverParams | None = None) -> spaces.Box:
        """(speed error m/s, yaw-rate error rad/s), unbounded."""
        return spaces.Box(-jnp.inf, jnp.inf, (2,), jnp.float32)


def _limits(params: RoverParams) -> jax.Array:
    """Largest command [2]."""
    return jnp.stack([float32(params.max_speed), float32(params.max_yaw_rate)])


def _errors(state: RoverState, params: RoverParams) -> jax.Array:
    """Observation [2]: motion minus target."""
    return jnp.stack(
        [
            state.speed - float32(params.target_speed),
            state.yaw_rate - float32(params.target_yaw_rate),
        ]
    )
