"""PID controllers with feed-forward and anti-windup."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike

from rtd3jax.envs.controllers.vectors import vector
from rtd3jax.envs.entry import parameters_of
from rtd3jax.envs.interface import describe
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.system.numbers import is_integer


class PIDState(NamedTuple):
    """The state of a PID controller.

    Attributes:
        time: int32 [], number of observations so far.
        integral: float32 [A], sum of the errors times the length of a step.
        error: float32 [A], the last error.
    """

    time: jax.Array
    integral: jax.Array
    error: jax.Array


@struct.dataclass
class PIDPolicy:
    """A PID controller for each element of the action; see `pid_policy`."""

    kp: jax.Array
    ki: jax.Array
    kd: jax.Array
    setpoint: jax.Array
    feedforward: jax.Array
    low: jax.Array
    high: jax.Array
    seconds: jax.Array
    elements: tuple[int, ...] = struct.field(pytree_node=False)
    ignored: int = struct.field(pytree_node=False)
    action_shape: tuple[int, ...] = struct.field(pytree_node=False)
    observation_size: int = struct.field(pytree_node=False)

    def init(self, key: jax.Array | None = None) -> PIDState:
        """The state before the first step of an episode: zero integral and error."""
        zeros = jnp.zeros_like(self.low)
        return PIDState(jnp.int32(0), zeros, zeros)

    def step(self, state: PIDState, observation: jax.Array) -> tuple[jax.Array, PIDState]:
        """The action, within its bounds, and the next state."""
        error = self.setpoint - observation[jnp.asarray(self.elements)].astype(jnp.float32)
        error = jnp.where(state.time < self.ignored, 0.0, error)
        integral = state.integral + error * self.seconds
        # The first error has no previous error, so its change is zero.
        change = jnp.where(state.time <= self.ignored, 0.0, error - state.error) / self.seconds
        wanted = self.feedforward + self.kp * error + self.ki * integral + self.kd * change
        action = jnp.clip(wanted, self.low, self.high)
        # Against wind-up: at a bound, the integral changes only if this leads away from the bound.
        winds_up = (wanted - action) * self.ki * error > 0
        integral = jnp.where(winds_up, state.integral, integral)
        after = PIDState(state.time + jnp.int32(1), integral, error)
        return action.reshape(self.action_shape), after


def pid_policy(
    env: EnvironmentLike,
    kp: ArrayLike | Sequence[float] = 0.0,
    ki: ArrayLike | Sequence[float] = 0.0,
    kd: ArrayLike | Sequence[float] = 0.0,
    *,
    setpoint: ArrayLike | Sequence[float] = 0.0,
    feedforward: ArrayLike | Sequence[float] = 0.0,
    elements: tuple[int, ...] | None = None,
    seconds: float = 1.0,
    ignored: int = 0,
    params: object = None,
) -> PIDPolicy:
    """A PID controller for each element of the action, with feed-forward and anti-windup.

    ``action = feedforward + kp e + ki sum(e) seconds + kd change(e) / seconds`` within the bounds
    of ``env``, with ``e = setpoint - observation[elements]``. Gains, set-point and feed-forward are
    numbers or arrays [A].

    Args:
        env: the environment, which defines sizes and bounds; it may be disturbed.
        kp: gain of the error.
        ki: gain of the error's integral.
        kd: gain of the error's rate of change.
        setpoint: target values of the chosen elements of the observation.
        feedforward: the action at zero error.
        elements: index of the observation's element that each element of the action controls; the
            first A elements by default.
        seconds: length of a step in seconds; with 1, time is counted in steps.
        ignored: number of observations at the start of an episode that the controller ignores. If
            the plant starts at rest and responds to each command within one step, then the error
            of the first observation was not caused by any command.
        params: the environment's parameters; its default parameters by default.

    Raises:
        UserError: for gains that have a wrong shape or are not finite, and for indices that the
            observation does not have.
    """
    params = parameters_of(env, params)
    own = describe(env, params)
    size = own.action_size
    if elements is None and own.observation_size < size:
        raise UserError(
            f"pid_policy: {own.observation_size} observation elements for {size} actions: "
            "pass elements=(...), the index of the element that each action controls"
        )
    try:
        chosen = tuple(range(size) if elements is None else elements)
    except TypeError:  # one number
        chosen = ()
    inside = all(is_integer(k) and 0 <= k < own.observation_size for k in chosen)
    if len(chosen) != size or not inside:
        raise UserError(
            f"pid_policy: elements must be {size} integers from 0 to {own.observation_size - 1}, "
            f"not {elements!r}"
        )
    number = np.ndim(seconds) == 0 and np.asarray(seconds).dtype.kind in "iuf"
    if not (number and np.isfinite(seconds) and seconds > 0):
        raise UserError(f"pid_policy: seconds must be greater than 0, not {seconds!r}")
    if not is_integer(ignored) or ignored < 0:
        raise UserError(f"pid_policy: ignored must be an integer of at least 0, not {ignored!r}")
    values = {"kp": kp, "ki": ki, "kd": kd, "setpoint": setpoint, "feedforward": feedforward}
    arrays = {name: vector("pid_policy", name, value, size) for name, value in values.items()}
    return PIDPolicy(
        **arrays,
        low=jnp.asarray(own.action_low),
        high=jnp.asarray(own.action_high),
        seconds=jnp.float32(seconds),
        elements=tuple(int(k) for k in chosen),
        ignored=int(ignored),
        action_shape=own.action_shape,
        observation_size=own.observation_size,
    )
