"""Metrics of learning, averaged between evaluations inside the jitted loop.

Shapes: ``K`` evaluations, ``M`` metrics, ``E`` environments.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.agents.learners.base import Metrics

EXPLORATION_RETURN = "exploration_return"
"""Name of the mean return, with exploration, of training episodes that ended in an interval."""


@struct.dataclass
class Averages:
    """Averages of past intervals, and sums of the current interval.

    Attributes:
        totals: float32 [M], sums of the measurements in this interval.
        counts: float32 [M], numbers of measurements.
        episode_return: float32 [E], the return so far of each environment's current episode.
        curves: float32 [K, M], averages; NaN without measurements.
        names: names of the metrics.
    """

    totals: jax.Array
    counts: jax.Array
    episode_return: jax.Array
    curves: jax.Array
    names: tuple[str, ...] = struct.field(pytree_node=False)


def metric_names(learner: tuple[str, ...]) -> tuple[str, ...]:
    """The names of all metrics, including those that the learner measures, ``learner``."""
    return (*learner, EXPLORATION_RETURN)


def empty_averages(learner: tuple[str, ...], evaluations: int, environments: int) -> Averages:
    """Averages without measurements, for a learner that measures ``learner``."""
    names = metric_names(learner)
    zeros = jnp.zeros((len(names),), jnp.float32)
    curves = jnp.full((evaluations, len(names)), jnp.nan, jnp.float32)
    returns = jnp.zeros((environments,), jnp.float32)
    return Averages(zeros, zeros.copy(), returns, curves, names)


def note_update(averages: Averages, found: Metrics) -> Averages:
    """Add the measurements of an update."""
    missing = [name for name in averages.names[:-1] if name not in found]
    assert not missing, f"the learner's update does not measure {missing}"
    pairs = [found[name] for name in averages.names[:-1]]
    nothing = jnp.float32(0.0)
    totals = jnp.stack([*(pair.total for pair in pairs), nothing])
    counts = jnp.stack([*(pair.times for pair in pairs), nothing])
    return dataclasses.replace(
        averages, totals=averages.totals + totals, counts=averages.counts + counts
    )


def note_reward(averages: Averages, reward: jax.Array, done: jax.Array) -> Averages:
    """Add the ``reward`` [E] of a step; ``done`` bool [E]: whether the step ended its episode."""
    total = averages.episode_return + reward
    last = jnp.arange(len(averages.names), dtype=jnp.int32) == len(averages.names) - 1
    ended, count = jnp.sum(jnp.where(done, total, 0.0)), jnp.sum(done).astype(jnp.float32)
    return dataclasses.replace(
        averages,
        totals=averages.totals + jnp.where(last, ended, 0.0),
        counts=averages.counts + jnp.where(last, count, 0.0),
        episode_return=jnp.where(done, 0.0, total),
    )


def averaged(averages: Averages, index: jax.Array) -> Averages:
    """End interval ``index`` (int32 []): store its averages, and set the sums to zero."""
    means = jnp.where(averages.counts > 0, averages.totals / averages.counts, jnp.nan)
    return dataclasses.replace(
        averages,
        totals=jnp.zeros_like(averages.totals),
        counts=jnp.zeros_like(averages.counts),
        curves=averages.curves.at[index].set(means),
    )
