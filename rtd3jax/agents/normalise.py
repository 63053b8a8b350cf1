"""Normalises observations by their running mean and standard deviation, for the networks.

The replay stores observations without normalisation. A network reads ``(observation - mean) /
deviation``, element by element, with the current statistics. ``O`` is the size of an observation.
"""

import dataclasses
from typing import overload

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.agents.history import History, Steps, Window

LIMIT = 10.0
"""Normalised observations are clipped to ±LIMIT, so that an outlier has a limited effect."""

_RESOLVED = 1e-6
"""A deviation below this fraction of the mean is treated as a rounding error of float32."""


@struct.dataclass
class Normaliser:
    """An element-wise linear map of observations.

    Attributes:
        mean: [O], in the observation's units.
        scale: [O], the inverse deviation; one for an element that is constant.
    """

    mean: jax.Array
    scale: jax.Array

    def __call__(self, observation: jax.Array) -> jax.Array:
        """The normalised ``observation`` [..., O], clipped to [-LIMIT, LIMIT]."""
        ones = (1,) * (observation.ndim - 1)
        mean, scale = self.mean.reshape(*ones, -1), self.scale.reshape(*ones, -1)
        return jnp.clip((observation - mean) * scale, -LIMIT, LIMIT)


@struct.dataclass
class Statistics:
    """Running statistics of a lane's observations.

    Attributes:
        count: int32 [], number of observations so far.
        origin: [O], the first observation. Means are relative to it: beside a large offset, float32
            would round the small changes of a mean to zero.
        relative_mean: [O], the mean of the observations minus ``origin``.
        variance: [O], the population variance of these observations.
    """

    count: jax.Array
    origin: jax.Array
    relative_mean: jax.Array
    variance: jax.Array

    @property
    def mean(self) -> jax.Array:
        """[O], in the observation's units."""
        return self.origin + self.relative_mean

    def note(self, observations: jax.Array) -> "Statistics":
        """The statistics after K more ``observations`` [K, O] (Welford 1962; Chan et al. 1983)."""
        number = observations.shape[0]
        count = self.count + jnp.int32(number)
        share = number / count.astype(jnp.float32)
        origin = jnp.where(self.count == 0, observations[0], self.origin)
        relative = observations - origin[None, :]
        centre = jnp.mean(relative, axis=0)
        within = jnp.mean(jnp.square(relative - centre[None, :]), axis=0)
        change = centre - self.relative_mean
        mean = self.relative_mean + share * change
        # The mean of squares, not their sum: the mean does not grow, so float32 resolves it.
        between = (1.0 - share) * jnp.square(change)
        variance = self.variance + share * (within + between - self.variance)
        return Statistics(count, origin, mean, variance)

    def normaliser(self) -> Normaliser:
        """The normalisation with these statistics."""
        deviation = jnp.sqrt(jnp.maximum(self.variance, 0.0))
        changes = deviation > _RESOLVED * jnp.abs(self.mean)
        return Normaliser(self.mean, jnp.where(changes, 1.0 / jnp.where(changes, deviation, 1), 1))


def no_statistics(observation_size: int) -> Statistics:
    """The statistics of zero observations."""
    zeros = jnp.zeros((observation_size,), jnp.float32)
    return Statistics(jnp.int32(0), zeros, zeros, zeros)


def as_read(observation: jax.Array, normaliser: Normaliser | None) -> jax.Array:
    """``observation`` [..., O], normalised unless ``normaliser`` is None."""
    return observation if normaliser is None else normaliser(observation)


@overload
def normalised(
    history: Window, normaliser: Normaliser | None, of_truth: Normaliser | None = None
) -> Window: ...


@overload
def normalised(
    history: History, normaliser: Normaliser | None, of_truth: Normaliser | None = None
) -> History: ...


def normalised(
    history: History, normaliser: Normaliser | None, of_truth: Normaliser | None = None
) -> History:
    """``history`` with all observations normalised, unless ``normaliser`` is None.

    ``of_truth`` normalises the undisturbed observations, which have statistics of their own: a
    disturbance may hide an element, whose deviation would then be unknown.
    """

    def of(steps: Steps) -> Steps:
        return dataclasses.replace(steps, observation=as_read(steps.observation, normaliser))

    if history.true_observation is not None:
        true = as_read(history.true_observation, of_truth)
        history = dataclasses.replace(history, true_observation=true)
    observation = as_read(history.observation, normaliser)
    if isinstance(history, Window):
        return dataclasses.replace(history, past=of(history.past), observation=observation)
    return dataclasses.replace(history, steps=of(history.steps), observation=observation)
