"""A differential-drive rover with wheel slip (paper, Section 8.2).

Units: m, s, rad. The left wheel comes first. The motion has no inertia: each command sets the wheel
speeds of its own step. The only hidden variable is the slip, which acts inside the dynamics.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.typing import ArrayLike

from rtd3jax.envs.identity import strong
from rtd3jax.envs.processes.process import NoDisturbance, Process, float32
from rtd3jax.envs.rover.scene import RoverScene
from rtd3jax.envs.rover.slip import WHEELS
from rtd3jax.envs.rover.task import DrivingTask, errors, limits, sides


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


class Rover(DrivingTask):
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
        return errors(state, params), strong(state)

    def step_env(
        self, key: jax.Array, state: RoverState, action: ArrayLike, params: RoverParams
    ) -> tuple[jax.Array, RoverState, jax.Array, jax.Array, dict[Any, Any]]:
        """Command ``action`` [2]; the reward [] belongs to the resulting motion."""
        limit = limits(params)
        command = jnp.clip(jnp.asarray(action, jnp.float32), -limit, limit)
        wheelbase = float32(params.wheelbase)
        nominal = sides(command[0], command[1], wheelbase)
        realised, slip = params.slip.step(key, state.slip, nominal)
        evolved = RoverState(
            time=state.time + 1,
            speed=0.5 * (realised[0] + realised[1]),
            yaw_rate=(realised[1] - realised[0]) / wheelbase,
            slip=slip,
        )
        return self.outcome(evolved, params)

    def scene(self, params: RoverParams) -> RoverScene:
        """The drawing for the frames of an episode."""
        return RoverScene(params)

    @property
    def name(self) -> str:
        """The name used in messages."""
        return "rover"
