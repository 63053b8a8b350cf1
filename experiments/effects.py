"""Verdicts on differences of means over seeds: each an effect, with a t interval."""

import dataclasses

import numpy as np
from scipy import stats

FEWEST_SEEDS = 3
MARGIN = 0.02
"""Margin of equivalence of normalised returns; it was fixed before the runs."""
ROVER_MARGIN = MARGIN * 1.36
"""The same of the rover's returns: 2% of the paper's best."""
CONFIDENCE, EQUIVALENCE = 0.95, 0.90
"""Confidence of intervals, and of those that must lie within the margin. Two one-sided tests at 5%
each reject a difference beyond the margin exactly if the 90% interval lies within it (Schuirmann,
1987)."""
SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"
NO_EFFECT = "no effect"


def mean_interval(values: np.ndarray, confidence: float = CONFIDENCE) -> tuple[float, float, float]:
    """The mean of values and its t interval, which a single value does not have (NaN).

    A percentile bootstrap of five values covers the mean less often than it says: in 87% of cases
    instead of 95%, for normal values.
    """
    if len(values) < 2:
        return float(values.mean()), np.nan, np.nan
    error = float(values.std(ddof=1)) / np.sqrt(len(values))
    half = float(stats.t.ppf(0.5 + 0.5 * confidence, len(values) - 1)) * error
    mean = float(values.mean())
    return mean, mean - half, mean + half


@dataclasses.dataclass(frozen=True)
class Effect:
    """A difference that should be positive by a claim: its name, and both sides' values by seed.

    With ``paired``, both sides have the same seeds in the same order.
    """

    name: str
    better: np.ndarray
    worse: np.ndarray
    margin: float = MARGIN
    paired: bool = False

    def interval(self, confidence: float = CONFIDENCE) -> tuple[float, float, float]:
        """The difference of means and its interval, Welch's (1947) unless the sides are paired."""
        if self.paired:
            return mean_interval(self.better - self.worse, confidence)
        difference = float(self.better.mean() - self.worse.mean())
        if not (np.ptp(self.better) or np.ptp(self.worse)):  # without spread, Welch's is undefined
            return difference, difference, difference
        test = stats.ttest_ind(self.better, self.worse, equal_var=False)
        low, high = test.confidence_interval(confidence)
        return difference, float(low), float(high)

    def bound(self) -> float:
        """The smallest margin within which the two one-sided tests find no difference."""
        _, low, high = self.interval(EQUIVALENCE)
        return max(-low, high)

    def verdict(self) -> str:
        """Supported, contradicted, no effect or undecided."""
        if min(len(self.better), len(self.worse)) < FEWEST_SEEDS:
            return UNDECIDED
        _, low, high = self.interval()
        if low > 0 or high < 0:
            return SUPPORTED if low > 0 else CONTRADICTED
        return NO_EFFECT if self.bound() <= self.margin else UNDECIDED

    def text(self) -> str:
        """The numbers of the effect, for the table."""
        if min(len(self.better), len(self.worse)) < FEWEST_SEEDS:
            return f"{self.name}: too few seeds ({len(self.better)}, {len(self.worse)})"
        mean, low, high = self.interval()
        none = f", no effect beyond ±{self.bound():.3f}" if low <= 0 <= high else ""
        return f"{self.name}: {mean:+.3f} [{low:+.3f}, {high:+.3f}]{none}"


def combine(verdicts: list[str]) -> str:
    """The verdict of a claim with several comparisons: the worst one; undecided without any."""
    for verdict in (CONTRADICTED, UNDECIDED, NO_EFFECT):
        if verdict in verdicts:
            return verdict
    return SUPPORTED if verdicts else UNDECIDED


@dataclasses.dataclass(frozen=True)
class Equal(Effect):
    """A difference that should be zero by a claim: within the margin."""

    def verdict(self) -> str:
        """Supported if the tests find no difference beyond the margin, contradicted if it is."""
        if min(len(self.better), len(self.worse)) < FEWEST_SEEDS:
            return UNDECIDED
        if self.bound() <= self.margin:
            return SUPPORTED
        _, low, high = self.interval()
        return CONTRADICTED if low > self.margin or high < -self.margin else UNDECIDED
