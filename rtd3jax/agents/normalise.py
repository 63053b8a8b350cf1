"""Observations in running deviations about their running mean, for networks alone.

Replay keeps what was seen; a network reads ``(observation - mean) / deviation``, element by
element, under the statistics of the moment. ``O`` is the size of an observation.
"""

import dataclasses
from typing import overload

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.agents.history import History, Steps, Window

LIMIT = 10.0
"""Deviations from the mean beyond which a reading is cut off: one outlier cannot drown the rest."""

_RESOLVED = 1e-6
"""Deviations below this share of the mean are what float32 cannot tell from rounding."""


@struct.dataclass
class Normaliser:
    """An element-wise map that serves every observation of one policy.

    Attributes:
        mean: [O], in the observation's units.
        scale: [O], one over the deviation; one for an element that does not change.
    """

    mean: jax.Array
    scale: jax.Array

    def __call__(self, observation: jax.Array) -> jax.Array:
        """``observation`` [..., O] in deviations about the mean, between -LIMIT and LIMIT."""
        ones = (1,) * (observation.ndim - 1)
        mean, scale = self.mean.reshape(*ones, -1), self.scale.reshape(*ones, -1)
        return jnp.clip((observation - mean) * scale, -LIMIT, LIMIT)


@struct.dataclass
class Statistics:
    """Running statistics of a lane's observations.

    Attributes:
        count: int32 [], observations so far.
        mean: [O].
        variance: [O], of the population of those observations.
    """

    count: jax.Array
    mean: jax.Array
    variance: jax.Array

    def note(self, observations: jax.Array) -> "Statistics":
        """The statistics with K more ``observations`` [K, O] (Welford, 1962; Chan et al., 1983)."""
        number = observations.shape[0]
        count = self.count + jnp.int32(number)
        share = number / count.astype(jnp.float32)
        centre = jnp.mean(observations, axis=0)
        within = jnp.mean(jnp.square(observations - centre[None, :]), axis=0)
        change = centre - self.mean
        mean = self.mean + share * change
        # The mean of squares, not their sum: it does not grow, so float32 goes on resolving it.
        between = (1.0 - share) * jnp.square(change)
        variance = self.variance + share * (within + between - self.variance)
        return Statistics(count, mean, variance)

    def normaliser(self) -> Normaliser:
        """The map under these statistics."""
        deviation = jnp.sqrt(jnp.maximum(self.variance, 0.0))
        changes = deviation > _RESOLVED * jnp.abs(self.mean)
        return Normaliser(self.mean, jnp.where(changes, 1.0 / jnp.where(changes, deviation, 1), 1))


def no_statistics(observation_size: int) -> Statistics:
    """Before the first observation."""
    zeros = jnp.zeros((observation_size,), jnp.float32)
    return Statistics(jnp.int32(0), zeros, zeros)


def as_read(observation: jax.Array, normaliser: Normaliser | None) -> jax.Array:
    """``observation`` [..., O] as a network reads it: as it is without a normaliser."""
    return observation if normaliser is None else normaliser(observation)


@overload
def normalised(history: Window, normaliser: Normaliser | None) -> Window: ...


@overload
def normalised(history: History, normaliser: Normaliser | None) -> History: ...


def normalised(history: History, normaliser: Normaliser | None) -> History:
    """``history`` with every observation as a network reads it."""

    def of(steps: Steps) -> Steps:
        return dataclasses.replace(steps, observation=as_read(steps.observation, normaliser))

    observation = as_read(history.observation, normaliser)
    if isinstance(history, Window):
        return dataclasses.replace(history, past=of(history.past), observation=observation)
    return dataclasses.replace(history, steps=of(history.steps), observation=observation)
