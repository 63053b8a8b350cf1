"""What is measured while an agent learns, averaged between evaluations, inside the jitted loop.

Shapes: ``K`` evaluations, ``M`` metrics.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.agents.learners.base import Metrics

EXPLORATION_RETURN = "exploration_return"
"""Mean return of the training episodes that ended in an interval, with exploration."""


@struct.dataclass
class Averages:
    """Averages of past intervals, and sums of the present one.

    Attributes:
        totals: float32 [M], of what was measured in this interval.
        counts: float32 [M], how often.
        episode_return: float32 [E], of each environment's episode under way.
        curves: float32 [K, M], averages; NaN where nothing was measured.
        names: of the metrics.
    """

    totals: jax.Array
    counts: jax.Array
    episode_return: jax.Array
    curves: jax.Array
    names: tuple[str, ...] = struct.field(pytree_node=False)


def metric_names(learner: tuple[str, ...]) -> tuple[str, ...]:
    """All names, where the learner measures those of ``learner``."""
    return (*learner, EXPLORATION_RETURN)


def empty_averages(learner: tuple[str, ...], evaluations: int, environments: int) -> Averages:
    """Before the first step, for a learner that measures ``learner``."""
    names = metric_names(learner)
    zeros = jnp.zeros((len(names),), jnp.float32)
    curves = jnp.full((evaluations, len(names)), jnp.nan, jnp.float32)
    returns = jnp.zeros((environments,), jnp.float32)
    return Averages(zeros, zeros.copy(), returns, curves, names)


def note_update(averages: Averages, found: Metrics) -> Averages:
    """With the measurements of an update."""
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
    """With a step's ``reward`` [E]; ``done`` bool [E], whether its episode ended with it."""
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
    """At the end of interval ``index`` (int32 []): its averages kept, its sums forgotten."""
    means = jnp.where(averages.counts > 0, averages.totals / averages.counts, jnp.nan)
    return dataclasses.replace(
        averages,
        totals=jnp.zeros_like(averages.totals),
        counts=jnp.zeros_like(averages.counts),
        curves=averages.curves.at[index].set(means),
    )
