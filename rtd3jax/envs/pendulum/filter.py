"""A model-based reference policy for the disturbed pendulum: a Bayes filter and optimal values.

The filter (`rtd3jax.envs.pendulum.belief`) knows the dynamics, the distribution of starts and the
disturbance. The torque maximises the value averaged over the belief (QMDP: Littman, Cassandra and
Kaelbling, 1995). The average takes into account that the pendulum may be on either side of the top;
the torque for the mean state would not. QMDP assumes that the state is known from the next step on.
Under noise it is not known: the estimate changes randomly at each step. The values are therefore
those of a pendulum with an equal random disturbance of its state.

The mean return of this policy is a lower bound of the optimal return. A sine adds the same offset
to several elements, and the first observation never contains this offset (sin 0 = 0). So the first
observation determines the state, the differences of the elements correct the estimate later, and
the parameters of the wave need not be estimated.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from rtd3jax.envs.disturbed import Disturbed
from rtd3jax.envs.pendulum.belief import Belief, Sensor, correct, predict, prior, sigma_points
from rtd3jax.envs.pendulum.environment import Pendulum, PendulumParams
from rtd3jax.envs.pendulum.value_iteration import interpolate, optimal_values, swing, torques_to_try
from rtd3jax.envs.processes.disturbances import (
    DampedSine,
    GaussianNoise,
    Hidden,
    Sine,
    element_mask,
)
from rtd3jax.envs.processes.process import NoDisturbance, Process
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike

ANGLES, SPEEDS = 200, 160
"""Grid intervals of the values under noise; without noise, twice as many are used."""

STEPS = 200
"""Number of value functions, by remaining steps; with more steps, the torque is the same."""

EXACT = 1e-3
"""Standard deviation that is used without noise: above the rounding of float32."""

KICK = 0.08
"""Standard deviation of the estimate's random change per step, in rad per unit of sigma: a little
less than that of a steady-state Kalman filter of the upright pendulum."""

GAUSSIANS = 24
"""Number of the most likely Gaussians, over which the value is averaged."""


class FilterState(NamedTuple):
    """State of the policy: the belief, the last torque [], and the number of steps, int32 []."""

    belief: Belief
    torque: jax.Array
    time: jax.Array


@struct.dataclass
class FilterPolicy:
    """The torque that maximises the value averaged over the belief; see `filter_policy`.

    Attributes:
        pendulum: the pendulum's parameters.
        sensor: the model of the observations.
        values: float32 [K, angles, speeds + 1], values by remaining steps.
        cells: number of Gaussians along the angle and along the speed.
        observation_size: 3, or 2 without the speed.
    """

    pendulum: PendulumParams
    sensor: Sensor
    values: jax.Array
    cells: tuple[int, int] = struct.field(pytree_node=False)
    observation_size: int = struct.field(pytree_node=False)

    def init(self, key: jax.Array | None = None) -> FilterState:
        """An empty belief, which the first observation replaces; ``key`` is not used."""
        count = self.cells[0] * self.cells[1]
        nothing = Belief(
            jnp.zeros((count,), jnp.float32),
            jnp.zeros((count, 2), jnp.float32),
            jnp.zeros((count, 2, 2), jnp.float32),
        )
        return FilterState(nothing, jnp.float32(0.0), jnp.int32(0))

    def step(self, state: FilterState, observation: jax.Array) -> tuple[jax.Array, FilterState]:
        """The torque [1] for ``observation`` [observation_size], and the next state."""
        missing = jnp.zeros((3 - self.observation_size,), jnp.float32)
        seen = jnp.concatenate((jnp.asarray(observation, jnp.float32), missing))
        first = state.time == 0
        belief = jax.tree.map(
            lambda start, moved: jnp.where(first, start, moved),
            prior(self.sensor, seen, *self.cells),
            predict(state.belief, self.sensor, self.pendulum, state.torque),
        )
        told = jnp.where(first, self.sensor.first, self.sensor.later)
        belief = correct(belief, self.sensor, told, seen)
        torque = self._best_torque(belief, state.time)
        return torque[None], FilterState(belief, torque, state.time + jnp.int32(1))

    def _best_torque(self, belief: Belief, time: jax.Array) -> jax.Array:
        count = min(GAUSSIANS, belief.log_weight.shape[0])
        log_weight, likeliest = jax.lax.top_k(belief.log_weight, count)
        weight, points = sigma_points(
            Belief(log_weight, belief.mean[likeliest], belief.covariance[likeliest])
        )
        angle, speed = points[:, 0], points[:, 1]
        left = jnp.int32(self.pendulum.max_steps_in_episode) - 1 - time
        value = self.values[jnp.clip(left, 0, self.values.shape[0] - 1)]

        def mean_value(torque):
            after, speed_after, reward = swing(self.pendulum, angle, speed, torque)
            later = interpolate(value, after, speed_after, self.pendulum.max_speed)
            return weight @ (reward + later)

        torques = torques_to_try(self.pendulum.max_torque)
        return torques[jnp.argmax(jax.vmap(mean_value)(torques))]


def filter_policy(env: EnvironmentLike) -> FilterPolicy:
    """The model-based reference of a pendulum under ``env``'s disturbance.

    The policy maximises the reward of the true state, even if ``env`` computes the reward from the
    observation: the tables compare returns of the true state.

    Args:
        env: a pendulum, undisturbed or under ``noise``, ``hidden`` or one of the sines.

    Raises:
        UserError: for other environments and disturbances, for a sigma of each element, and for
            noise without gravity.
    """
    params, base = env.default_params, env
    process: Process = NoDisturbance()
    if isinstance(env, Disturbed):
        base, process = env.base, params.observation
        if not (
            isinstance(params.action, NoDisturbance) and isinstance(params.reward, NoDisturbance)
        ):
            raise UserError("filter_policy does not cover disturbed actions or rewards")
        params = params.env
    if not isinstance(base, Pendulum):
        raise UserError("filter_policy is only known for the pendulum")
    if isinstance(process, GaussianNoise) and np.ndim(process.sigma):
        raise UserError(
            "filter_policy only covers noise with the same sigma for all elements: pass one number "
            "as sigma"
        )
    sensor = _sensor(process)
    sigma = float(process.sigma) if isinstance(process, GaussianNoise) else 0.0
    noisy = sigma > EXACT
    if noisy and not params.g > 0:
        raise UserError(
            f"filter_policy needs gravity under noise: g={params.g} must be greater than 0"
        )
    kick = KICK * sigma if noisy else 0.0
    finer = 1 if noisy else 2
    values, _ = optimal_values(params, finer * ANGLES, finer * SPEEDS, STEPS, kick)
    cells = (32, 5) if noisy else (1, 9)
    size = 2 if isinstance(process, Hidden) else 3
    return FilterPolicy(params, sensor, jnp.asarray(values), cells, size)


def _sensor(process: Process) -> Sensor:
    """The model of observations under ``process``."""
    everything = np.eye(3, dtype=np.float32)
    first = later = everything
    sigma = EXACT
    if isinstance(process, GaussianNoise):
        sigma = max(float(process.sigma), EXACT)
    elif isinstance(process, Hidden) and process.element == 2:
        first = later = np.diag(np.asarray([1.0, 1.0, 0.0], np.float32))
    elif isinstance(process, Sine | DampedSine) and len(process.elements) > 1:
        mask = element_mask(process.elements, 3)
        later = everything - np.outer(mask, mask) / mask.sum()
    elif not isinstance(process, NoDisturbance):
        raise UserError(
            f"filter_policy does not cover this {type(process).__name__}; it covers noise, a "
            "hidden speed, and sines that disturb two elements or more"
        )
    return Sensor(jnp.float32(sigma), jnp.asarray(first), jnp.asarray(later))
