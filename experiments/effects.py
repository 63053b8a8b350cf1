"""Verdicts on differences of means over seeds: each an effect, with a t interval."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy import stats

FEWEST_SEEDS = 3
MARGIN = 0.02
"""Margin of equivalence of normalised returns; it was fixed before the runs."""
ROVER_MARGIN = MARGIN * 1.36
"""Margin of equivalence of the rover's returns: 2% of the paper's best return."""
CONFIDENCE, EQUIVALENCE = 0.95, 0.90
"""Confidence of intervals, and of those that must lie within the margin. Two one-sided tests at 5%
each reject a difference beyond the margin exactly if the 90% interval lies within it (Schuirmann,
1987)."""
FIRST_SEEDS, SECOND_SEEDS = 5, 15
"""The most seeds of a cell at the first test of a comparison, and at the second test. Each cell
with more than ``SECOND_SEEDS`` got them after a further test."""
FAILED = -0.1
"""A training with a lower normalised return has failed: random actions have 0."""
SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"
NO_EFFECT = "no effect"


Values = np.ndarray | Sequence["Values"]
"""The values of seeds, [seeds]; or a sequence of such values, one for each cell of a grid. All
entries of a sequence have the same weight; they may be sequences, and have different numbers of
seeds."""


def cells_of(values: Values, weight: float = 1.0) -> list[tuple[float, np.ndarray]]:
    """The arrays of seeds, one for each cell, and the cells' weights; their sum is ``weight``."""
    if isinstance(values, np.ndarray):
        return [(weight, values)]
    return [cell for part in values for cell in cells_of(part, weight / len(values))]


def first(values: Values, count: int) -> Values:
    """The first ``count`` seeds of each cell."""
    if isinstance(values, np.ndarray):
        return values[:count]
    return [first(part, count) for part in values]


def mean_interval(values: np.ndarray, confidence: float = CONFIDENCE) -> tuple[float, float, float]:
    """The mean of values and the bounds of its t interval; the bounds are NaN for a single value.

    The interval is not a percentile bootstrap: for five normal values, a bootstrap interval of 95%
    only contains the mean in 87% of cases.
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

    With ``paired``, the sides have the same cells, each with the same seeds in the same order. The
    difference is multiplied by ``factor``. ``parts`` are effects of which this one is the mean.

    Cells got more seeds if a comparison was undecided, so the comparison was tested again. Each of
    its tests has an equal share of the error (Bonferroni): with 15 seeds in a cell, the intervals
    have a confidence of 97.5% instead of 95%. ``other_tests`` counts tests that do not show in the
    number of seeds, such as those before a window length was added. Returns below ``failed`` belong
    to failed trainings.
    """

    name: str
    better: Values
    worse: Values
    margin: float = MARGIN
    paired: bool = False
    factor: float = 1.0
    other_tests: int = 0
    failed: float = FAILED
    parts: tuple["Effect", ...] = ()

    def looks(self) -> int:
        """How often the comparison was tested at most, which follows from the seeds of its cells.

        Cells got their second seeds together, and their third seeds one cell after the other.
        """
        sides = (self.better, self.worse)
        # A cell may occur at several window lengths.
        cells = {id(cell): cell for side in sides for _, cell in cells_of(side)}.values()
        second = any(len(cell) > FIRST_SEEDS for cell in cells)
        later = sum(len(cell) > SECOND_SEEDS for cell in cells)
        return 1 + second + later + self.other_tests

    def even(self) -> "Effect":
        """The effect with the first seeds of each cell: as many as the smallest cell of its side.

        Only some cells got more seeds. If one training in ten fails, six of ten cells
        with five seeds show no failure, and their variance does not tell that they may have some.
        Then a mean over cells with different numbers of seeds is less certain than its interval
        says. With the seeds that were planned for all cells, failures count as often as they occur;
        with all seeds, those count that were seen later. So `interval` contains both intervals.
        """
        better, worse = (
            first(side, count)
            for side, count in zip((self.better, self.worse), self.seeds(), strict=True)
        )
        return dataclasses.replace(self, better=better, worse=worse)

    def has_failures(self) -> bool:
        """Whether some trainings failed on a side whose cells differ in their numbers of seeds.

        A cell in which all trainings are below ``failed`` has no rare failures, but low returns.
        """
        for side in (self.better, self.worse):
            cells = [cell for _, cell in cells_of(side)]
            uneven = len({len(cell) for cell in cells}) > 1
            if uneven and any(0 < (cell < self.failed).mean() < 1 for cell in cells):
                return True
        return False

    def seeds(self) -> tuple[int, int]:
        """The fewest seeds of a cell, of each side."""
        sides = (self.better, self.worse)
        better, worse = (min((len(c) for _, c in cells_of(side)), default=0) for side in sides)
        return better, worse

    def interval(self, confidence: float = CONFIDENCE) -> tuple[float, float, float]:
        """The difference of means and its interval; the error is divided by `looks`.

        If `has_failures`, the interval also contains the interval of `even`.
        """
        confidence = 1.0 - (1.0 - confidence) / self.looks()
        mean, low, high = self._single_interval(confidence)
        if self.has_failures():
            _, low_even, high_even = self.even()._single_interval(confidence)
            low, high = min(low, low_even), max(high, high_even)
        return mean, low, high

    def _single_interval(self, confidence: float) -> tuple[float, float, float]:
        """The difference of means and its interval, Welch's (1947) unless the sides are paired.

        The mean of a side is the mean of its cells' means. Each cell of either side has its own
        variance, and the sum has the degrees of freedom of Welch and Satterthwaite; with one cell
        on each side, this is Welch's interval. If the sides are paired, the differences within
        pairs count.
        """
        better = cells_of(self.better, self.factor)
        worse = cells_of(self.worse, self.factor)
        if self.paired:
            pairs = zip(better, worse, strict=True)
            cells = [(weight, values - others) for (weight, values), (_, others) in pairs]
        else:
            cells = [*better, *((-weight, values) for weight, values in worse)]
        mean = float(sum(weight * cell.mean() for weight, cell in cells))
        parts = np.array([weight**2 * cell.var(ddof=1) / len(cell) for weight, cell in cells])
        variance = parts.sum()
        if not variance:
            return mean, mean, mean
        freedom = variance**2 / sum(
            part**2 / (len(cell) - 1) for part, (_, cell) in zip(parts, cells, strict=True)
        )
        half = float(stats.t.ppf(0.5 + 0.5 * confidence, freedom) * np.sqrt(variance))
        return mean, mean - half, mean + half

    def bound(self) -> float:
        """The smallest margin within which the two one-sided tests find no difference."""
        _, low, high = self.interval(EQUIVALENCE)
        return max(-low, high)

    def verdict(self) -> str:
        """Supported, contradicted, no effect or undecided."""
        if min(self.seeds()) < FEWEST_SEEDS:
            return UNDECIDED
        _, low, high = self.interval()
        if low > 0 or high < 0:
            return SUPPORTED if low > 0 else CONTRADICTED
        return NO_EFFECT if self.bound() <= self.margin else UNDECIDED

    def text(self) -> str:
        """The numbers of the effect, for the table."""
        if min(self.seeds()) < FEWEST_SEEDS:
            better, worse = self.seeds()
            return f"{self.name}: too few seeds ({better}, {worse})"
        mean, low, high = self.interval()
        none = f", no effect beyond ±{self.bound():.3f}" if low <= 0 <= high else ""
        looks = self.looks()
        remarks = [{1: "", 2: "tested twice"}.get(looks, f"tested {looks} times")]
        remarks += ["trainings failed"] * self.has_failures()
        remark = f" ({'; '.join(filter(None, remarks))})" if any(remarks) else ""
        return f"{self.name}: {mean:+.3f} [{low:+.3f}, {high:+.3f}]{none}{remark}"


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
        """Supported if the tests find no difference beyond the margin.

        Contradicted if the interval lies beyond the margin; otherwise undecided.
        """
        if min(self.seeds()) < FEWEST_SEEDS:
            return UNDECIDED
        if self.bound() <= self.margin:
            return SUPPORTED
        _, low, high = self.interval()
        return CONTRADICTED if low > self.margin or high < -self.margin else UNDECIDED
