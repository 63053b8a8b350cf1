"""The ground: soil and slope as correlated random fields, which are drawn in every episode.

A field is a function of the place, a sum of waves
``sqrt(2 / M) sum_m cos(k_m . place + phase_m)`` whose phases are uniform. Its mean is 0, and its
variance is 1. Over the episodes, the covariance of two places with the difference d is the mean of
``cos(k_m . d)``. The wave vectors k_m are constants. They are spread over a normal distribution, so
that the covariance is nearly ``exp(-|d|^2 / (2 L^2))``, with the correlation length L (Rahimi and
Recht, "Random Features for Large-Scale Kernel Machines", 2007). So the soils under the two wheels
are correlated, and a rover that returns to a place finds the same soil there.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from rtd3jax.envs.processes.process import Process, float32, require
from rtd3jax.envs.rover_soil.soil import DRY_SAND, LocalSoil, Soil, local_soil
from rtd3jax.envs.rover_soil.wheel import cosine_of

WAVES = 8
"""M, the number of waves of a field."""


class Spread(NamedTuple):
    """Standard deviations of a soil's properties from the published ones [choice].

    Attributes:
        cohesion: deviation of the logarithm of the cohesion.
        friction_angle: deviation of the friction angle, in degrees.
        shear_modulus: deviation of the logarithm of the shear modulus.
        pressure: deviation of the logarithm of the pressure at one depth, and so of the logarithms
            of both sinkage moduli.
        exponent: deviation of the logarithm of the exponent.
    """

    cohesion: float = 0.2
    friction_angle: float = 1.5
    shear_modulus: float = 0.2
    pressure: float = 0.2
    exponent: float = 0.03


SPREAD = Spread()
FIELDS = (*Spread._fields, "other", "height")
"""The quantities with a field each: the properties, the share of the other soil, and the height."""
SHARPNESS = 3.0
"""Sharpness of the border between two soils [choice]: the share of the other soil is a logistic
function of its field times this number."""


class GroundState(struct.PyTreeNode):
    """The ground of one episode."""

    phases: jax.Array
    """float32 [M, FIELDS], in turns"""


class Ground(Process):
    """Soil whose properties vary around ``soil``, or between ``soil`` and ``other``, and a slope.

    The ground does not change a signal. The rover calls `at` with the places of its wheels.
    """

    soil: Soil = DRY_SAND
    other: Soil = DRY_SAND
    """the other soil, whose share at a place is determined by a field"""
    variation: float = 1.0
    """factor of the standard deviations in ``SPREAD``"""
    correlation_length: float = 1.0
    """m, correlation length of the soil [choice]"""
    slope: float = 0.0
    """degrees, standard deviation of the slope in any direction"""
    slope_length: float = 4.0
    """m, correlation length of the height [choice]"""

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> GroundState:
        """Draw the phases."""
        return GroundState(jax.random.uniform(key, (WAVES, len(FIELDS)), jnp.float32))

    def step(self, key: jax.Array, state: GroundState, signal: jax.Array) -> tuple[jax.Array, Any]:
        """The unchanged signal and state."""
        return signal, state

    def at(
        self, state: GroundState, places: jax.Array, heading: jax.Array, width: jax.Array
    ) -> tuple[LocalSoil, jax.Array]:
        """The soil under the wheels, and the slope ahead of the rover.

        Args:
            state: the ground of the episode.
            places: [W, 2], positions of the W wheels, m.
            heading: [], direction of the rover, rad.
            width: [], width of a wheel, m.

        Returns:
            The soil, fields [W], and the slope [] in the middle between the wheels, rad; a rise
            ahead is positive.
        """
        soils, size = len(FIELDS) - 1, float32(np.sqrt(2.0 / WAVES))
        waves = jnp.asarray(VECTORS, jnp.float32)
        scaled = (places / float32(self.correlation_length))[:, None, :]

        def add(fields: jax.Array, wave: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
            vectors, phases = wave
            return fields + cosine_of_turns(_along(vectors[None], scaled) + phases[None]), None

        fields = jnp.zeros((places.shape[0], soils), jnp.float32)
        fields, _ = jax.lax.scan(add, fields, (waves[:, :soils], state.phases[:, :soils]))
        fields = size * fields
        middle = jnp.mean(places, axis=0) / float32(self.slope_length)
        direction = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
        # The derivative of cos(2 pi turns) is a sine, which is a cosine a quarter turn earlier.
        turns = _along(waves[:, soils], middle) + state.phases[:, soils]
        ahead = -2.0 * jnp.pi * _along(waves[:, soils], direction)
        slope = size * jnp.sum(ahead * cosine_of_turns(turns - 0.25))
        return self._soil(fields, width), jnp.deg2rad(float32(self.slope)) * slope

    def _soil(self, fields: jax.Array, width: jax.Array) -> LocalSoil:
        """The soil [W] for the values [W, FIELDS - 1] of all fields except the height."""
        share = jax.nn.sigmoid(float32(SHARPNESS) * fields[:, FIELDS.index("other")])
        one, two = (local_soil(soil, width) for soil in (self.soil, self.other))

        def between(name: str) -> jax.Array:
            low, high = getattr(one, name), getattr(two, name)
            return low + share * (high - low)

        def varied(name: str) -> jax.Array:
            deviation = float32(getattr(SPREAD, name)) * float32(self.variation)
            return deviation * fields[:, FIELDS.index(name)]

        angle = jnp.arctan(between("friction")) + jnp.deg2rad(varied("friction_angle"))
        exponent = between("exponent") * jnp.exp(varied("exponent"))
        return LocalSoil(
            cohesion=between("cohesion") * jnp.exp(varied("cohesion")),
            friction=jnp.tan(jnp.clip(angle, 0.0, float32(np.radians(50.0)))),
            shear_modulus=between("shear_modulus") * jnp.exp(varied("shear_modulus")),
            pressure=between("pressure") * jnp.exp(varied("pressure")),
            exponent=jnp.clip(exponent, 0.5, 1.5),
            peak_offset=between("peak_offset"),
            peak_slope=between("peak_slope"),
            exit_ratio=between("exit_ratio"),
        )

    def validate(self) -> None:
        """Check both soils and the fields."""
        self.soil.validate()
        self.other.validate()
        require(self, "variation", low=0, high=2)
        require(self, "correlation_length", above=0)
        require(self, "slope", low=0, high=10)
        require(self, "slope_length", above=0)


def _along(vectors: jax.Array, place: jax.Array) -> jax.Array:
    """Scalar products of wave vectors [..., 2] and a place [..., 2]."""
    return vectors[..., 0] * place[..., 0] + vectors[..., 1] * place[..., 1]


def cosine_of_turns(turns: jax.Array) -> jax.Array:
    """``cos(2 pi turns)``, within 2e-6, from the series of the cosine of half the angle."""
    half = jnp.pi * (turns - jnp.round(turns))
    cosine = cosine_of(half)
    return 2.0 * cosine * cosine - 1.0


def _wave_vectors() -> np.ndarray:
    """The wave vectors [M, FIELDS, 2], in turns, for a correlation length of 1.

    Two vectors of equal length and orthogonal directions form a pair, so that a field varies
    equally in all directions. The squared length has the distribution of -2 ln(1 - u), where u is
    uniform. This distribution is divided into parts of equal probability, and the mean of each part
    is the squared length of a pair. The directions of successive pairs differ by the golden angle,
    and those of successive fields by a tenth of it.
    """
    edges = np.linspace(1.0, 0.0, WAVES // 2 + 1)
    below = np.where(edges > 0.0, edges * np.log(np.maximum(edges, 1e-9)), 0.0)
    squares = 2.0 - 2.0 * np.diff(below) / np.diff(edges)
    lengths = np.repeat(np.sqrt(squares), 2) / (2.0 * np.pi)
    golden = np.pi * (3.0 - np.sqrt(5.0))
    pairs = golden * np.arange(WAVES // 2)[:, None] + 0.1 * golden * np.arange(len(FIELDS))
    angles = np.stack([pairs, pairs + 0.5 * np.pi], axis=1).reshape(WAVES, len(FIELDS))
    return lengths[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


VECTORS = _wave_vectors()
