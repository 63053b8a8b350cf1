"""Verdicts on differences of means: each an effect, with a bootstrap interval over seeds."""

import dataclasses

import numpy as np

FEWEST_SEEDS = 3
MARGIN = 0.02
"""Margin of equivalence of normalised returns; it was fixed before the runs."""
RESAMPLES = 10_000
SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"
NO_EFFECT = "no effect"


def resampled_means(values: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """The means of ``RESAMPLES`` bootstrap samples of ``values``."""
    return values[random.integers(0, len(values), (RESAMPLES, len(values)))].mean(axis=1)


@dataclasses.dataclass(frozen=True)
class Effect:
    """A difference that should be positive by a claim: its name, and both sides' values by seed."""

    name: str
    better: np.ndarray
    worse: np.ndarray
    margin: float = MARGIN

    def interval(self) -> tuple[float, float, float]:
        """The difference of means and its bootstrap interval."""
        random = np.random.default_rng(0)
        means = [resampled_means(side, random) for side in (self.better, self.worse)]
        low, high = np.quantile(means[0] - means[1], (0.025, 0.975))
        return float(self.better.mean() - self.worse.mean()), float(low), float(high)

    def verdict(self) -> str:
        """Supported, contradicted, no effect or undecided."""
        if min(len(self.better), len(self.worse)) < FEWEST_SEEDS:
            return UNDECIDED
        _, low, high = self.interval()
        if low > 0 or high < 0:
            return SUPPORTED if low > 0 else CONTRADICTED
        return NO_EFFECT if max(-low, high) <= self.margin else UNDECIDED

    def text(self) -> str:
        """The numbers of the effect, for the table."""
        if min(len(self.better), len(self.worse)) < FEWEST_SEEDS:
            return f"{self.name}: too few seeds ({len(self.better)}, {len(self.worse)})"
        mean, low, high = self.interval()
        none = f", no effect beyond ±{max(-low, high):.3f}" if low <= 0 <= high else ""
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
        """Supported if the interval lies within the margin, contradicted if it lies outside."""
        if min(len(self.better), len(self.worse)) < FEWEST_SEEDS:
            return UNDECIDED
        _, low, high = self.interval()
        if low >= -self.margin and high <= self.margin:
            return SUPPORTED
        return CONTRADICTED if low > self.margin or high < -self.margin else UNDECIDED
