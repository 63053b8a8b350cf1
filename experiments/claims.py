"""The paper's fifteen claims, each tested on whatever results are there.

Usage: python experiments/claims.py [--results DIR] [--out DIR]

An effect is a difference of means over seeds with a 95% bootstrap interval (seeds resampled within
each side, 10,000 times, fixed random numbers). *Supported* means that the interval lies on the
claim's side of zero, *contradicted* that it lies on the other, *undecided* that it has zero in it
or that there are fewer than three seeds on a side. A claim of several comparisons is as its worst
one; a claim of no effect is supported where the interval lies within a margin that is stated.
Writes claims.md and .parquet.
"""

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Callable

import numpy as np
import pandas as pd

import rtd3jax as rtd

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from writing import RESULTS, markdown_table, provenance, write_results  # noqa: E402

FEWEST_SEEDS = 3
RESAMPLES = 10_000
LSTM_AGENTS = [a for a in rtd.ALGORITHMS if a.startswith("lstm")]
BEST = "lstm-td3-1ha1hc"
SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"


@dataclasses.dataclass(frozen=True)
class Effect:
    """A difference that a claim says is positive: its name, the two sides' values by seed."""

    name: str
    better: np.ndarray
    worse: np.ndarray

    def interval(self) -> tuple[float, float, float]:
        """The difference of means, and its bootstrap interval."""
        random = np.random.default_rng(0)
        means = [
            side[random.integers(0, len(side), (RESAMPLES, len(side)))].mean(axis=1)
            for side in (self.better, self.worse)
        ]
        low, high = np.quantile(means[0] - means[1], (0.025, 0.975))
        return float(self.better.mean() - self.worse.mean()), float(low), float(high)

    def verdict(self) -> str:
        """Supported, contradicted or undecided."""
        if min(len(self.better), len(self.worse)) < FEWEST_SEEDS:
            return UNDECIDED
        _, low, high = self.interval()
        return SUPPORTED if low > 0 else CONTRADICTED if high < 0 else UNDECIDED

    def text(self) -> str:
        """The numbers, for the table."""
        if min(len(self.better), len(self.worse)) < FEWEST_SEEDS:
            return f"{self.name}: too few seeds ({len(self.better)}, {len(self.worse)})"
        mean, low, high = self.interval()
        return f"{self.name}: {mean:+.2f} [{low:+.2f}, {high:+.2f}]"


def combine(verdicts: list[str]) -> str:
    """A claim of several comparisons: contradicted by any, supported by all."""
    if CONTRADICTED in verdicts:
        return CONTRADICTED
    return SUPPORTED if verdicts and set(verdicts) == {SUPPORTED} else UNDECIDED


class Rover:
    """The rover's results: a row per policy and process."""

    def __init__(self, table: pd.DataFrame | None):
        self._table = table

    def values(self, algorithm: str, trained: str, tested: str = "ar1-slip") -> np.ndarray:
        """Mean return of each seed."""
        if self._table is None:
            return np.empty(0)
        t = self._table
        rows = (t["algorithm"] == algorithm) & (t["trained_on"] == trained)
        return t[rows & (t["tested_on"] == tested)].sort_values("seed")["mean"].to_numpy()


def agents_beat_td3(rover: Rover) -> list[Effect]:
    """Claim 12."""
    td3 = rover.values("td3", "ar1-slip")
    return [Effect(f"{a} over td3", rover.values(a, "ar1-slip"), td3) for a in LSTM_AGENTS]


def sine_over_none(rover: Rover) -> list[Effect]:
    """Claim 13."""
    return [
        Effect(f"{a}, sine over none", rover.values(a, "sine-slip"), rover.values(a, "none"))
        for a in rtd.ALGORITHMS
        if a != "td3"
    ]


def best_transfer(rover: Rover) -> list[Effect]:
    """Claim 14."""
    best = rover.values(BEST, "sine-slip")
    others = [a for a in rtd.ALGORITHMS if a != BEST]
    return [Effect(f"{BEST} over {a}", best, rover.values(a, "sine-slip")) for a in others]


def slip_variants(rover: Rover) -> list[Effect]:
    """Claim 15: of the three variants high variance is the worst and fast slip the best."""
    effects = []
    for a in rtd.ALGORITHMS:
        high, fast, slow = (
            rover.values(a, "sine-slip", f"ar1-slip-{kind}")
            for kind in ("high-variance", "fast", "slow")
        )
        effects += [
            Effect(f"{a}, slow over high variance", slow, high),
            Effect(f"{a}, fast over slow", fast, slow),
        ]
    return effects


CLAIMS: tuple[tuple[int, str, Callable[[Rover], list[Effect]] | None], ...] = (
    (1, "fully observable: action history changes nothing", None),
    (2, "`temporal-bias`: action history makes no clear difference", None),
    (3, "`temporal-sine`: longer windows and action history help", None),
    (4, "`random-sine`: action history helps", None),
    (5, "`noise`: action history helps, a larger sigma hurts, longer windows help", None),
    (6, "`hidden`: the final return depends on neither", None),
    (7, "every LSTM agent beats `td3` under partial observability", None),
    (8, "one stream beats two; `lstm-td3-1ha1hc` is the most robust", None),
    (9, "`h-td3` matches `lstm-td3` except under `noise`", None),
    (10, "`h-td3` has the shortest iteration", None),
    (11, "agents trained on `random-sine` carry over, except to `noise`", None),
    (12, "rover on AR(1) slip: every LSTM agent beats `td3`", agents_beat_td3),
    (13, "training on sine slip transfers better than training without slip", sine_over_none),
    (14, "`lstm-td3-1ha1hc` transfers best from sine to AR(1) slip", best_transfer),
    (15, "high variance hurts most, fast slip is the easiest", slip_variants),
)


def judge(rover: Rover) -> pd.DataFrame:
    """A row per claim: number, claim, verdict, effects."""
    rows = []
    for number, claim, effects_of in CLAIMS:
        effects = [] if effects_of is None else effects_of(rover)
        there = [effect for effect in effects if len(effect.better) and len(effect.worse)]
        rows.append(
            {
                "claim": number,
                "text": claim,
                "verdict": combine([effect.verdict() for effect in effects]),
                "effects": "; ".join(effect.text() for effect in there) or "not run yet",
            }
        )
    return pd.DataFrame(rows)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=pathlib.Path, default=RESULTS)
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parser.parse_args(arguments)
    file = options.results / "rover.parquet"
    table = judge(Rover(pd.read_parquet(file) if file.exists() else None))
    text = markdown_table(
        ["", "the paper's claim", "verdict", "effect: difference of mean returns [95% interval]"],
        [[str(row.claim), row.text, row.verdict, row.effects] for row in table.itertuples()],
    )
    write_results(options.out, "claims", table, text, provenance(resamples=RESAMPLES))
    print(text)


if __name__ == "__main__":
    main()
