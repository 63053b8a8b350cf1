"""Tests the paper's fifteen claims with the available results.

Usage: python experiments/claims.py [--results DIR] [--out DIR]

An effect is a difference of means over seeds with a 95% interval (Welch, 1947). The margin of
equivalence is 0.02 of a normalised return, which was fixed before the runs; on the rover it is 2%
of the paper's best return.

A claim of a positive effect is *supported* if the interval lies above zero, and *contradicted* if
it lies below zero. The verdict is *no effect* if the interval contains zero and two one-sided
tests (5% each; Schuirmann, 1987) reject differences beyond the margin. A claim of no effect is
supported if these tests do so, and contradicted if the interval lies outside the margin. Otherwise
the verdict is *undecided*: there are too few seeds, or they differ too much. A claim with several
comparisons has the verdict of the worst comparison.

The values are returns for the rover, and normalised returns of the current settings for the
pendulum, as means over the window lengths that all sides of a comparison have. The trainings of a
comparison count as independent; each window length has a variance of its own, since the seeds of
short windows differ most. Trainings with the same seed are a little alike, at other lengths and of
other agents: claims.json has both correlations. The first makes a mean less certain than its
interval says, the second makes a difference more certain. For iteration times, rounds of the
benchmark replace seeds. The clauses of claims 5, 6, 7 and 9 on the speed and
the course of learning are not tested; the learning curves show them. Claim 11 is tested by the
returns under each condition, which also depend on how difficult the condition is. The script
writes claims.md and .parquet.
"""

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Callable, Collection

import numpy as np
import pandas as pd

import rtd3jax as rtd

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from effects import CONFIDENCE, ROVER_MARGIN, Effect, Equal, Values, combine  # noqa: E402
from pendulum_cells import current_setting  # noqa: E402
from writing import RESULTS, markdown_table, provenance, write_results  # noqa: E402

PARTIAL = ("temporal-sine", "random-sine", "noise", "hidden")
HARD_NOISE = "noise:sigma=1.0"
BIAS = "temporal-bias:amplitude_min=1.0,amplitude_max=1.0"
LSTM_AGENTS = [a for a in rtd.ALGORITHMS if a.startswith("lstm")]
RECURRENT = [*LSTM_AGENTS, "h-td3"]
"""All agents with an LSTM layer."""
BEST = "lstm-td3-1ha1hc"


@dataclasses.dataclass(frozen=True)
class Results:
    """The tables of the experiments; empty tables for experiments that were not run."""

    rover: pd.DataFrame
    pendulum: pd.DataFrame
    generalisation: pd.DataFrame
    bench: pd.DataFrame

    @classmethod
    def read(cls, directory: pathlib.Path) -> "Results":
        """Read the directory of results."""
        files = [directory / f"{name}.parquet" for name in ("rover", "pendulum", "generalisation")]
        tables = [pd.read_parquet(file) if file.exists() else pd.DataFrame() for file in files]
        tables[1:] = [current(table) for table in tables[1:]]
        bench = directory / "benchmarks" / "measurements.csv"
        return cls(*tables, pd.read_csv(bench) if bench.exists() else pd.DataFrame())

    def on_rover(self, algorithm: str, trained: str, tested: str = "ar1-slip") -> np.ndarray:
        """Mean return of each seed."""
        key = {"algorithm": algorithm, "trained_on": trained, "tested_on": tested}
        return _by_seed(self.rover, key, "mean")

    def on_pendulum(
        self, algorithm: str, disturbance: str, lengths: Collection[int]
    ) -> list[np.ndarray]:
        """Normalised return of each seed: for agents with a window, an array for each length."""
        key = {"algorithm": algorithm, "disturbance": disturbance}
        if self.pendulum.empty:
            return []
        known = self.pendulum["history_length"].isin([0, *lengths])
        return _by_length(self.pendulum[known], key, "normalised")

    def lengths(self, algorithm: str, disturbance: str) -> list[int]:
        """Window lengths with which the agent was trained under the disturbance."""
        if self.pendulum.empty:
            return []
        own = _rows(self.pendulum, {"algorithm": algorithm, "disturbance": disturbance})
        return sorted(int(length) for length in own["history_length"].unique())

    def compared(self, *sides: tuple[str, str]) -> tuple[str, list[list[np.ndarray]]]:
        """The normalised returns of each agent and disturbance, with the same window lengths.

        While the trainings are incomplete, one side may have window lengths that another lacks.
        Only the lengths of all sides count; `td3`, which has no window, counts with each.

        Returns:
            The lengths, as text for the name of the effect, and for each side an array of seeds for
            each length.
        """
        windows = [set(self.lengths(*side)) for side in sides if side[0] != "td3"]
        shared = sorted(set.intersection(*windows)) if windows else []
        listed = f" (l = {', '.join(map(str, shared))})" if shared else ""
        return listed, [self.on_pendulum(*side, shared) for side in sides]

    def carried(self, algorithm: str, tested: str) -> list[np.ndarray]:
        """Normalised returns of an agent of `random-sine` under another condition, as above."""
        key = {"algorithm": algorithm, "tested_on": tested}
        return _by_length(self.generalisation, key, "normalised")

    def rates(self, algorithm: str, length: int) -> np.ndarray:
        """Seed-steps per second in each round of the benchmark."""
        key = {"agent": algorithm, "history_length": length, "measurement": "rtd3jax float32"}
        return _rows(self.bench, key)["value"].to_numpy() if len(self.bench) else np.empty(0)


def current(table: pd.DataFrame) -> pd.DataFrame:
    """The rows with the current settings and the full size of each agent.

    Trainings with other settings, another width or another length are left out.
    """
    if table.empty:
        return table
    if "setting" in table:
        table = table[table["setting"] == table["algorithm"].map(current_setting)]
    for size in ("width", "steps"):
        if size in table and len(table):
            table = table[table[size] == table.groupby("algorithm")[size].transform("max")]
    return table


def _rows(table: pd.DataFrame, key: dict) -> pd.DataFrame:
    return table[(table[list(key)] == list(key.values())).all(axis=1)]


def _by_seed(table: pd.DataFrame, key: dict, column: str) -> np.ndarray:
    if table.empty:
        return np.empty(0)
    return _rows(table, key).groupby("seed")[column].mean().to_numpy()


def _by_length(table: pd.DataFrame, key: dict, column: str) -> list[np.ndarray]:
    if table.empty:
        return []
    rows = _rows(table, key)
    return [own[column].to_numpy() for _, own in rows.groupby("history_length")]


def likeness(pendulum: pd.DataFrame, across: str) -> float | None:
    """The correlation of trainings with the same seed that differ in ``across`` alone.

    What correlates is the deviation of a training from its cell's mean, in standard deviations. The
    result is None without such pairs.
    """
    cell = ["algorithm", "disturbance", "history_length"]
    if pendulum.empty:
        return None
    of_cells = pendulum.groupby(cell)["normalised"]
    deviation = (pendulum["normalised"] - of_cells.transform("mean")) / of_cells.transform("std")
    rows = pendulum[[*cell, "seed"]].assign(deviation=deviation).dropna()
    pairs = rows.merge(rows, on=[*(name for name in cell if name != across), "seed"])
    pairs = pairs[pairs[f"{across}_x"] != pairs[f"{across}_y"]]
    if pairs.empty:
        return None
    return round(float(pairs["deviation_x"].corr(pairs["deviation_y"])), 2)


def history_is_nothing(disturbance: str) -> Callable[[Results], list[Effect]]:
    """Claims 1 and 2."""
    return lambda results: equal(history_helps(results, disturbance))


def equal(effects: list[Effect]) -> list[Effect]:
    """The same differences, which should be zero by the claim."""
    return [Equal(effect.name, effect.better, effect.worse) for effect in effects]


def on_the_pendulum(
    results: Results,
    name: str,
    better: tuple[str, str],
    worse: tuple[str, str],
    kind: type[Effect] = Effect,
) -> Effect:
    """An effect between two pairs of an agent and a disturbance, at their common lengths."""
    lengths, sides = results.compared(better, worse)
    return kind(f"{name}{lengths}", *sides)


def history_helps(results: Results, disturbance: str) -> list[Effect]:
    """Action history helps."""
    better, worse = "lstm-td3", "lstm-td3-no-action"
    sides = (better, disturbance), (worse, disturbance)
    return [on_the_pendulum(results, f"{better} over {worse}", *sides)]


def length_helps(results: Results, disturbance: str) -> list[Effect]:
    """The longest window over the shortest."""
    lengths = results.lengths("lstm-td3", disturbance)
    if len(lengths) < 2:  # without a comparison, the claim is undecided
        return [Effect("lstm-td3, longest over shortest window", [], [])]
    long, short = (results.on_pendulum("lstm-td3", disturbance, [lengths[k]]) for k in (-1, 0))
    return [Effect(f"lstm-td3, l={lengths[-1]} over l={lengths[0]}", long, short)]


def temporal_sine(results: Results) -> list[Effect]:
    """Claim 3."""
    return history_helps(results, "temporal-sine") + length_helps(results, "temporal-sine")


def noise(results: Results) -> list[Effect]:
    """Claim 5, without the fall of returns late in training, which the curves show."""
    found = history_helps(results, "noise") + length_helps(results, "noise")
    sides = ("lstm-td3", "noise"), ("lstm-td3", HARD_NOISE)
    return [*found, on_the_pendulum(results, "lstm-td3, sigma 0.5 over 1.0", *sides)]


def hidden(results: Results) -> list[Effect]:
    """Claim 6."""
    return equal(history_helps(results, "hidden") + length_helps(results, "hidden"))


def memory_helps(results: Results) -> list[Effect]:
    """Claim 7."""
    return [
        on_the_pendulum(
            results, f"{name}: {agent} over td3", better=(agent, name), worse=("td3", name)
        )
        for name in PARTIAL
        for agent in RECURRENT
    ]


def one_stream(results: Results) -> list[Effect]:
    """Claim 8: on average over the disturbances; `lstm-td3-1ha2hc` has one stream in its actor."""
    found, one = [], "lstm-td3-1ha2hc"
    others = [(BEST, agent) for agent in rtd.ALGORITHMS if agent != BEST]
    for best, agent in [*others, (one, "lstm-td3")]:
        pairs = [(name, disturbance) for name in (best, agent) for disturbance in PARTIAL]
        lengths, sides = results.compared(*pairs)
        halves = sides[: len(PARTIAL)], sides[len(PARTIAL) :]
        means: list[Values] = [
            [seeds for side in half for seeds in side] if all(half) else [] for half in halves
        ]
        found.append(Effect(f"{best} over {agent}{lengths}", *means))
    return found


def stored_carries(results: Results) -> list[Effect]:
    """Claim 9."""
    return [
        on_the_pendulum(
            results,
            f"{name}: lstm-td3 over h-td3",
            better=("lstm-td3", name),
            worse=("h-td3", name),
            kind=Effect if name == "noise" else Equal,
        )
        for name in PARTIAL
    ]


def iteration_time(results: Results) -> list[Effect]:
    """Claim 10: the rate at every length, and the share of the rate at the longest window."""
    found, lengths = [], (1, 3, 6, 10, 20)
    for agent in LSTM_AGENTS:
        found += [
            Effect(f"l={n}: h-td3 over {agent}", results.rates("h-td3", n), results.rates(agent, n))
            for n in lengths
            if len(results.rates(agent, n)) and len(results.rates("h-td3", n))
        ]
        kept = [
            results.rates(name, 20) / results.rates(name, 1)
            if len(results.rates(name, 20)) == len(results.rates(name, 1))
            else np.empty(0)
            for name in ("h-td3", agent)
        ]
        found.append(Effect(f"share of the rate kept at l=20: h-td3 over {agent}", *kept))
    return found


def carries_over(results: Results) -> list[Effect]:
    """Claim 11: each of the three conditions over noise."""
    return [
        Effect(
            f"{agent}: {condition.partition(':')[0]} over noise",
            results.carried(agent, condition),
            results.carried(agent, HARD_NOISE),
        )
        for agent in RECURRENT
        for condition in ("combined-sine", "damped-sine", BIAS)
    ]


def on_the_rover(name: str, better: np.ndarray, worse: np.ndarray) -> Effect:
    """An effect on the rover's returns, which are not normalised."""
    return Effect(name, better, worse, ROVER_MARGIN)


def agents_beat_td3(results: Results) -> list[Effect]:
    """Claim 12."""
    td3 = results.on_rover("td3", "ar1-slip")
    return [on_the_rover(f"{a} over td3", results.on_rover(a, "ar1-slip"), td3) for a in RECURRENT]


def sine_over_none(results: Results) -> list[Effect]:
    """Claim 13."""
    return [
        on_the_rover(
            f"{a}, sine over none", results.on_rover(a, "sine-slip"), results.on_rover(a, "none")
        )
        for a in rtd.ALGORITHMS
    ]


def best_transfer(results: Results) -> list[Effect]:
    """Claim 14."""
    best = results.on_rover(BEST, "sine-slip")
    others = [a for a in rtd.ALGORITHMS if a != BEST]
    return [
        on_the_rover(f"{BEST} over {a}", best, results.on_rover(a, "sine-slip")) for a in others
    ]


def slip_variants(results: Results) -> list[Effect]:
    """Claim 15: of the three variants, high variance is the worst, and fast slip is the best."""
    effects = []
    for a in rtd.ALGORITHMS:
        high, fast, slow = (
            results.on_rover(a, "sine-slip", f"ar1-slip-{kind}")
            for kind in ("high-variance", "fast", "slow")
        )
        effects += [
            on_the_rover(f"{a}, slow over high variance", slow, high),
            on_the_rover(f"{a}, fast over slow", fast, slow),
        ]
    return effects


CLAIMS: tuple[tuple[int, str, Callable[[Results], list[Effect]]], ...] = (
    (1, "fully observable: action history changes nothing", history_is_nothing("none")),
    (
        2,
        "`temporal-bias`: action history makes no clear difference",
        history_is_nothing("temporal-bias"),
    ),
    (3, "`temporal-sine`: longer windows and action history help", temporal_sine),
    (4, "`random-sine`: action history helps", lambda r: history_helps(r, "random-sine")),
    (5, "`noise`: action history helps, a larger sigma hurts, longer windows help", noise),
    (6, "`hidden`: the final return depends on neither", hidden),
    (7, "every agent with an LSTM beats `td3` under partial observability", memory_helps),
    (8, "one stream beats two; `lstm-td3-1ha1hc` is the most robust", one_stream),
    (9, "`h-td3` matches `lstm-td3` except under `noise`", stored_carries),
    (10, "`h-td3` has the shortest iteration, least sensitive to the window", iteration_time),
    (11, "agents trained on `random-sine` carry over, except to `noise`", carries_over),
    (12, "rover on AR(1) slip: every agent with an LSTM beats `td3`", agents_beat_td3),
    (13, "training on sine slip transfers better than training without slip", sine_over_none),
    (14, "`lstm-td3-1ha1hc` transfers best from sine to AR(1) slip", best_transfer),
    (15, "high variance hurts most, fast slip is the easiest", slip_variants),
)


def judge(results: Results) -> pd.DataFrame:
    """A row per claim: number, claim, verdict, a summary, and a line for each effect."""
    rows = []
    for number, claim, effects_of in CLAIMS:
        effects = effects_of(results)
        there = [effect for effect in effects if len(effect.better) and len(effect.worse)]
        verdicts = [effect.verdict() for effect in effects]
        counts = {verdict: verdicts.count(verdict) for verdict in dict.fromkeys(verdicts)}
        if len(effects) == 1 and there:
            summary = there[0].text()
        else:
            summary = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
        rows.append(
            {
                "claim": number,
                "text": claim,
                "verdict": combine(verdicts),
                "summary": summary if there else "not run yet",
                "effects": "\n".join(effect.text() for effect in there) or "not run yet",
            }
        )
    return pd.DataFrame(rows)


def markdown(table: pd.DataFrame) -> str:
    """A line per claim, and a folded list of its comparisons."""
    lines = markdown_table(
        ["", "the paper's claim", "verdict", "comparisons: difference of means [95% interval]"],
        [[str(row.claim), row.text, row.verdict, row.summary] for row in table.itertuples()],
    )
    folded = [
        f"<details><summary>{row.claim}. {row.text}</summary>\n\n"
        + "\n".join(f"- {effect}" for effect in row.effects.splitlines())
        + "\n\n</details>"
        for row in table.itertuples()
        if "\n" in row.effects
    ]
    return "\n\n".join([lines, *folded])


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=pathlib.Path, default=RESULTS)
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parser.parse_args(arguments)
    results = Results.read(options.results)
    table = judge(results)
    text = markdown(table)
    facts = provenance(
        confidence=CONFIDENCE,
        correlation_of_a_seed_at_two_lengths=likeness(results.pendulum, "history_length"),
        correlation_of_a_seed_of_two_agents=likeness(results.pendulum, "algorithm"),
    )
    write_results(options.out, "claims", table, text, facts)
    print(text)


if __name__ == "__main__":
    main()
