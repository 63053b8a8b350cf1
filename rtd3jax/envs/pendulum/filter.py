"""A model-based reference for the disturbed pendulum: a Bayes filter with the optimal values.

The filter (`rtd3jax.envs.pendulum.belief`) knows the dynamics, the distribution of starts and the
disturbance. The torque maximises the value averaged over its belief (QMDP: Littman, Cassandra and
Kaelbling, 1995), which averages over sides that the pendulum may be on where the best torque for
the mean state would not. QMDP takes the state to be known from the next step on. Under noise it is
not: the estimate keeps being kicked, so the values are those of a pendulum that is kicked alike.

What it earns is a lower bound of what can be earned. A sine adds one offset to several elements,
and the first observation never carries one (sin 0 = 0): the state is known from then on, and the
elements' differences keep the estimate true, so the wave's own parameters need not be inferred.
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
"""Grid intervals of the values under noise; twice as many where the state becomes known."""

STEPS = 200
"""Values kept, by steps to go; with more to go the torque no longer depends on how many."""

EXACT = 1e-3
"""Standard deviation that stands for none: above the rounding of float32 observations."""

KICK = 0.08
"""Standard deviation of the estimate's kick per step, rad for a unit of sigma: a little less than a
steady Kalman filter of the upright pendulum has."""

GAUSSIANS = 24
"""The likeliest, over which the value is averaged."""


class FilterState(NamedTuple):
    """What the policy remembers: its belief, the torque [] it gave last, int32 [] steps done."""

    belief: Belief
    torque: jax.Array
    time: jax.Array


@struct.dataclass
class FilterPolicy:
    """The torque of the best value averaged over the belief; see `filter_policy`.

    Attributes:
        pendulum: the pendulum's parameters.
        sensor: what observations tell.
        values: float32 [K, angles, speeds + 1], by steps to go.
        cells: Gaussians along the angle and along the speed.
        observation_size: 3, or 2 without the speed.
    """

    pendulum: PendulumParams
    sensor: Sensor
    values: jax.Array
    cells: tuple[int, int] = struct.field(pytree_node=False)
    observation_size: int = struct.field(pytree_node=False)

    def init(self, key: jax.Array | None = None) -> FilterState:
        """Nothing is known; the first observation makes the prior. ``key`` is not needed."""
        count = self.cells[0] * self.cells[1]
        nothing = Belief(
            jnp.zeros((count,), jnp.float32),
            jnp.zeros((count, 2), jnp.float32),
            jnp.zeros((count, 2, 2), jnp.float32),
        )
        return FilterState(nothing, jnp.float32(0.0), jnp.int32(0))

    def step(self, state: FilterState, observation: jax.Array) -> tuple[jax.Array, FilterState]:
        """The torque [1] for ``observation`` [observation_size], and the belief that gave it."""
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

        def worth(torque):
            after, speed_after, reward = swing(self.pendulum, angle, speed, torque)
            later = interpolate(value, after, speed_after, self.pendulum.max_speed)
            return weight @ (reward + later)

        torques = torques_to_try(self.pendulum.max_torque)
        return torques[jnp.argmax(jax.vmap(worth)(torques))]


def filter_policy(env: EnvironmentLike) -> FilterPolicy:
    """The model-based reference of a pendulum under ``env``'s disturbance.

    It maximises the true state's reward, whichever reward ``env`` gives: that is what the tables
    compare.

    Args:
        env: a pendulum, as it is or under ``noise``, ``hidden`` or one of the sines.

    Raises:
        UserError: for other environments and disturbances.
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
        raise UserError("filter_policy is known for the pendulum alone")
    sensor = _sensor(process)
    sigma = float(process.sigma) if isinstance(process, GaussianNoise) else 0.0
    noisy = sigma > EXACT
    kick = KICK * sigma if noisy else 0.0
    finer = 1 if noisy else 2
    values, _ = optimal_values(params, finer * ANGLES, finer * SPEEDS, STEPS, kick)
    cells = (32, 5) if noisy else (1, 9)
    size = 2 if isinstance(process, Hidden) else 3
    return FilterPolicy(params, sensor, jnp.asarray(values), cells, size)


def _sensor(process: Process) -> Sensor:
    """What observations under ``process`` tell."""
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
            f"filter_policy does not cover {type(process).__name__} as it is set here; it covers "
            "noise, hidden without the speed, and sines that add to two elements or more"
        )
    return Sensor(jnp.float32(sigma), jnp.asarray(first), jnp.asarray(later))
