"""A Gaussian-sum filter for the state of a pendulum.

The start is random, the dynamics are deterministic for a known torque, and the observation is
disturbed. The posterior of the state is a sum of Gaussians, each with its own extended Kalman
filter (Alspach and Sorenson, 1972; Anderson and Moore, Optimal Filtering, 1979, Section 8.4). The
first observation determines the Gaussians; they are so narrow that cos and sin are nearly linear
over each of them.

Units: rad and rad/s. A state is (theta, theta dot); theta is not limited to one turn, because only
its cosine and sine are used.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.envs.pendulum.environment import PendulumParams
from rtd3jax.envs.pendulum.value_iteration import START_SPEED, swing

DRIFT, DRIFT_PER_SIGMA = 1e-3, 1e-2
"""Standard deviation of the process noise per step of both elements of the state: a constant, and
a factor of the observation noise. It covers the error of the linearisation. Without it, the
covariance of an undisturbed motion shrinks to zero, and the filter may diverge."""


@struct.dataclass
class Sensor:
    """A model of the information in an observation (cos theta, sin theta, theta dot).

    Attributes:
        sigma: standard deviation of the white noise on the projected observation.
        first: float32 [3, 3], projection onto the part of the first observation that is used.
        later: float32 [3, 3], projection for all later observations. If several elements share an
            unknown offset, only their differences are used.
    """

    sigma: jax.Array
    first: jax.Array
    later: jax.Array


class Belief(NamedTuple):
    """A sum of M Gaussians over the state.

    Attributes:
        log_weight: float32 [M], the logarithms of weights that add up to one.
        mean: float32 [M, 2].
        covariance: float32 [M, 2, 2].
    """

    log_weight: jax.Array
    mean: jax.Array
    covariance: jax.Array


def prior(sensor: Sensor, observation: jax.Array, angles: int, speeds: int) -> Belief:
    """The distribution of starts, limited to those that the first observation [3] allows.

    The starts are uniform: theta over one turn, and theta dot in [-1, 1]. The part within six
    standard deviations of the observation is divided into ``angles`` times ``speeds`` equal cells.
    Each cell becomes a Gaussian with the cell's moments; `correct` then weights the Gaussians.
    """
    sees_angle, sees_speed = sensor.first[0, 0] > 0, sensor.first[2, 2] > 0
    reach = 6.0 * sensor.sigma
    seen = jnp.arctan2(observation[1], observation[0])
    # On the unit circle, noise changes the direction by at most its length.
    half_turn = jnp.where(sees_angle, jnp.minimum(reach, math.pi), math.pi)
    low = jnp.clip(
        jnp.where(sees_speed, observation[2] - reach, -jnp.inf), -START_SPEED, START_SPEED
    )
    high = jnp.clip(
        jnp.where(sees_speed, observation[2] + reach, jnp.inf), -START_SPEED, START_SPEED
    )
    angle = seen + half_turn * _centres(angles)
    speed = 0.5 * (low + high) + 0.5 * (high - low) * _centres(speeds)
    mean = jnp.stack(jnp.meshgrid(angle, speed, indexing="ij"), axis=-1).reshape(-1, 2)
    widths = jnp.stack((2.0 * half_turn / angles, (high - low) / speeds))
    covariance = jnp.diag(widths**2 / 12.0 + _drift(sensor) ** 2)
    cells = angles * speeds
    return Belief(
        jnp.full((cells,), -math.log(cells), jnp.float32),
        mean,
        jnp.broadcast_to(covariance, (cells, 2, 2)),
    )


def _centres(cells: int) -> jax.Array:
    """Centres [cells] of equal cells of [-1, 1]."""
    return (2.0 * jnp.arange(cells, dtype=jnp.float32) + 1.0) / cells - 1.0


def _drift(sensor: Sensor) -> jax.Array:
    return DRIFT + DRIFT_PER_SIGMA * sensor.sigma


def predict(belief: Belief, sensor: Sensor, params: PendulumParams, torque: jax.Array) -> Belief:
    """The belief one step later, after ``torque`` []."""

    def move(state):
        angle, speed, _ = swing(params, state[0], state[1], torque)
        return jnp.stack((angle, speed))

    mean = jax.vmap(move)(belief.mean)
    slope = jax.vmap(jax.jacfwd(move))(belief.mean)
    covariance = slope @ belief.covariance @ slope.mT + _drift(sensor) ** 2 * jnp.eye(2)[None]
    return Belief(belief.log_weight, mean, covariance)


def correct(
    belief: Belief, sensor: Sensor, projection: jax.Array, observation: jax.Array
) -> Belief:
    """The belief after ``observation`` [3], of which the part ``projection`` [3, 3] is used.

    The update is in information form, which allows projections of any rank.
    """
    precision = sensor.sigma**-2

    def one(mean, covariance):
        angle, speed = mean
        expected = jnp.stack((jnp.cos(angle), jnp.sin(angle), speed))
        zero = jnp.zeros_like(angle)
        slope = jnp.stack(
            (
                jnp.stack((-jnp.sin(angle), zero)),
                jnp.stack((jnp.cos(angle), zero)),
                jnp.stack((zero, zero + 1.0)),
            )
        )
        surprise = projection @ (observation - expected)
        told = precision * slope.T @ projection @ slope
        inflated = jnp.eye(2) + covariance @ told
        determinant = inflated[0, 0] * inflated[1, 1] - inflated[0, 1] * inflated[1, 0]
        adjugate = jnp.stack(
            (
                jnp.stack((inflated[1, 1], -inflated[0, 1])),
                jnp.stack((-inflated[1, 0], inflated[0, 0])),
            )
        )
        after = adjugate @ covariance / determinant
        after = 0.5 * (after + after.T)
        pull = precision * slope.T @ surprise
        # log N(surprise; 0, S) without the term that all Gaussians share, by the matrix
        # determinant lemma and Woodbury's identity for S = slope covariance slope' + sigma^2.
        fit = precision * surprise @ surprise - pull @ after @ pull
        return mean + after @ pull, after, -0.5 * (fit + jnp.log(determinant))

    mean, covariance, log_likelihood = jax.vmap(one)(belief.mean, belief.covariance)
    log_weight = belief.log_weight + log_likelihood
    return Belief(log_weight - jax.nn.logsumexp(log_weight), mean, covariance)


def sigma_points(belief: Belief) -> tuple[jax.Array, jax.Array]:
    """Weights [4 M] and states [4 M, 2] with the moments of each Gaussian.

    The points are those of the third-degree cubature rule: the mean plus and minus sqrt(2) times
    the columns of the covariance's Cholesky factor (Arasaratnam and Haykin, 2009).
    """
    variance, shared, other = (
        belief.covariance[:, 0, 0],
        belief.covariance[:, 0, 1],
        belief.covariance[:, 1, 1],
    )
    tiny = 1e-12
    first = jnp.sqrt(jnp.maximum(variance, tiny))
    second = shared / first
    third = jnp.sqrt(jnp.maximum(other - second**2, tiny))
    columns = (jnp.stack((first, second), -1), jnp.stack((jnp.zeros_like(third), third), -1))
    offsets = [sign * math.sqrt(2.0) * column for column in columns for sign in (1.0, -1.0)]
    points = jnp.concatenate([belief.mean + offset for offset in offsets])
    return jnp.tile(jnp.exp(belief.log_weight) / 4.0, 4), points
