"""Statistics over the seeds of one experimental cell.

The unit of replication is the seed, not the episode: episodes of one trained agent are not
independent evidence about its algorithm. The aggregates follow Agarwal, Schwarzer, Castro,
Courville and Bellemare, "Deep Reinforcement Learning at the Edge of the Statistical Precipice",
NeurIPS 2021: the interquartile mean (IQM), percentile bootstrap intervals and the probability of
improvement. A cell is a single task, so their bootstrap, which is stratified by task, is a plain
bootstrap over seeds here.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import stats

from rtd3jax.study.results import CELL

TRIM = 0.25  # fraction of seeds cut from each side for the IQM
CONFIDENCE = 0.95
RESAMPLES = 2_000
BOOTSTRAP_SEED = 0  # fixed: the same results always give the same interval
MOST_POINTS = 200
"""Maximum number of points of a curve in figures and on the page: others would cost seconds."""
_BLOCK = 64
"""Number of points whose resamples are in memory at the same time."""


@dataclass(frozen=True)
class Summary:
    """Aggregates of one cell, in the units of its values (returns)."""

    n: int  # seeds with a finite value
    mean: float
    std: float  # over seeds, ddof = 1; nan when n < 2
    iqm: float
    iqm_low: float  # bounds of the 95 % bootstrap interval; nan when n < 2
    iqm_high: float
    failed: int = 0  # seeds dropped because their value was not finite


def seed_means(episodes: pd.DataFrame) -> pd.DataFrame:
    """Average the EPISODES rows of each lane.

    Returns one row per (cell, seed) with columns env, disturbance, algorithm, history_length,
    seed, return and true_return (float64). A lane with a NaN episode has a NaN mean: the mean of
    the other episodes would be too high for a policy that sometimes diverges.
    """
    lanes = episodes.astype({"return": np.float64, "true_return": np.float64})
    grouped = lanes.groupby([*CELL, "seed"], sort=True, as_index=False)
    return grouped[["return", "true_return"]].mean(skipna=False)


def reference_mean(returns: pd.Series) -> float:
    """Mean over the episodes of a policy that was not trained; NaN if one has no number.

    As for a lane, the mean of its other episodes would be too high.
    """
    return float(returns.astype(np.float64).mean(skipna=False))


def summarise(values: ArrayLike) -> Summary:
    """Summarise ``values`` [seeds], one number per seed; NaN and infinity mark a failed seed.

    The IQM removes ``floor(n / 4)`` seeds from each side, so it equals the mean for n < 4.
    """
    finite, failed = _finite(values)
    n = finite.size
    if n == 0:
        return Summary(0, math.nan, math.nan, math.nan, math.nan, math.nan, failed)
    low = high = std = math.nan
    if n >= 2:
        std = float(finite.std(ddof=1))
        low, high = map(float, _bootstrap_interval(finite))
    return Summary(n, float(finite.mean()), std, float(_iqm(finite)), low, high, failed)


def iqm_bands(values: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`summarise` at every point of a curve.

    For ``values`` [seeds, K], it returns the number of seeds with a finite value, int [K], and the
    IQM with the bounds of its interval, float64 [K] each. The IQM is nan without a seed, and the
    bounds are nan with fewer than two seeds.
    """
    array = np.asarray(values, np.float64)
    finite = np.isfinite(array)
    iqm, low, high = (np.full(array.shape[1], np.nan) for _ in range(3))
    # Points with the same seeds share one set of resamples, which does not depend on the block.
    patterns, which = np.unique(finite, axis=1, return_inverse=True)
    for index in range(patterns.shape[1]):
        points = np.flatnonzero(which.ravel() == index)
        kept = array[np.ix_(patterns[:, index], points)]
        if kept.shape[0] >= 1:
            iqm[points] = _iqm(kept, axis=0)
        if kept.shape[0] >= 2:
            for start in range(0, points.size, _BLOCK):  # all at once need 500 MiB for 1,000 points
                block = slice(start, start + _BLOCK)
                low[points[block]], high[points[block]] = _bootstrap_interval(kept[:, block])
    return finite.sum(axis=0), iqm, low, high


def thinned(table: pd.DataFrame) -> pd.DataFrame:
    """The table with at most `MOST_POINTS` columns, evenly spaced, with the first and the last."""
    if table.shape[1] <= MOST_POINTS:
        return table
    points = np.linspace(0, table.shape[1] - 1, MOST_POINTS).round().astype(int)
    return table.iloc[:, np.unique(points)]


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> float:
    """Probability that a random seed of ``x`` [n] exceeds one of ``y`` [m]; a tie counts half.

    This is the Mann-Whitney U statistic divided by n * m. Failed (non-finite) seeds are left out;
    the result is nan if a side has no seed.
    """
    first, _ = _finite(x)
    second, _ = _finite(y)
    if first.size == 0 or second.size == 0:
        return math.nan
    wins = first[:, None] > second[None, :]
    ties = first[:, None] == second[None, :]
    return float(np.mean(wins + 0.5 * ties))


@dataclass(frozen=True)
class Comparison:
    """How much better ``y`` is than ``x``, with 95 % bootstrap intervals over seeds."""

    pairs: int  # common seeds of a paired difference; 0 if it is not paired
    difference: float  # mean of y minus x; nan when either side has no finite value
    difference_low: float  # nan when either side has fewer than two
    difference_high: float
    improvement: float  # probability that a random seed of y exceeds one of x
    improvement_low: float
    improvement_high: float


def compare(x: Mapping[int, float], y: Mapping[int, float]) -> Comparison:
    """Compare the value of each seed of ``y`` with those of ``x``, the baseline.

    Equal seeds have equal starts, so the difference is paired over the seeds with a finite value on
    both sides, if there are at least two. Otherwise it is the difference of the two means. The
    probability of improvement is over all seeds. Failed seeds (non-finite values) are left out.
    """
    first, second = (
        {seed: value for seed, value in sorted(values.items()) if math.isfinite(value)}
        for values in (x, y)
    )
    nan = math.nan
    if not first or not second:
        return Comparison(0, nan, nan, nan, nan, nan, nan)
    of_x, of_y = np.array(list(first.values())), np.array(list(second.values()))
    common = [seed for seed in first if seed in second]
    if len(common) >= 2:
        pairs = np.sort(np.array([second[seed] - first[seed] for seed in common]))
        difference = float(pairs.mean())
    else:
        common = []
        difference = float(of_y.mean() - of_x.mean())
    improvement = probability_of_improvement(of_y, of_x)
    if min(of_x.size, of_y.size) < 2:
        return Comparison(len(common), difference, nan, nan, improvement, nan, nan)
    # How often each seed is drawn, [RESAMPLES, n] for each side.
    random = np.random.default_rng(BOOTSTRAP_SEED)
    if common:
        drawn = [random.multinomial(pairs.size, np.full(pairs.size, 1 / pairs.size), RESAMPLES)]
        differences = drawn[0] @ pairs / pairs.size
    drawn = [random.multinomial(n, np.full(n, 1 / n), RESAMPLES) for n in (of_x.size, of_y.size)]
    of_x, of_y = np.sort(of_x), np.sort(of_y)
    if not common:
        differences = drawn[1] @ of_y / of_y.size - drawn[0] @ of_x / of_x.size
    wins = (of_y[:, None] > of_x[None, :]) + 0.5 * (of_y[:, None] == of_x[None, :])
    chances = np.sum((drawn[1] @ wins) * drawn[0], axis=1) / wins.size
    ends = (*_percentiles(differences), improvement, *_percentiles(chances))
    return Comparison(len(common), difference, *ends)


def _percentiles(values: np.ndarray) -> tuple[float, float]:
    """The bounds of the central 95 % of ``values``."""
    low, high = np.quantile(values, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def _finite(values: ArrayLike) -> tuple[np.ndarray, int]:
    """The finite entries as float64 [n], and the number of other entries."""
    array = np.asarray(values, dtype=np.float64).ravel()
    finite = array[np.isfinite(array)]
    return finite, array.size - finite.size


def _iqm(values: np.ndarray, axis: int = -1) -> np.ndarray:
    return stats.trim_mean(values, TRIM, axis=axis)


def _bootstrap_interval(values: np.ndarray) -> tuple[Any, Any]:
    """95 % percentile bootstrap interval of the IQM of ``values`` [n >= 2, ...] over the seeds."""
    # Sorted, because resamples choose positions: the order of seeds must not matter.
    result = stats.bootstrap(
        (np.sort(values, axis=0),),
        _iqm,
        axis=0,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        vectorized=True,
        rng=np.random.default_rng(BOOTSTRAP_SEED),
    )
    return result.confidence_interval.low, result.confidence_interval.high
