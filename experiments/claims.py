"""Tests the paper's fifteen claims with the available results.

Usage: python experiments/claims.py [--results DIR] [--out DIR]

An effect is a difference of means over seeds with a 95% interval (Welch, 1947). The margin of
equivalence is 0.02 of a normalised return, which was fixed before the runs; on the rover it is 2%
of the paper's best return.

A claim of a positive effect is *supported* if the interval lies above zero, and *contradicted* if
it lies below zero. The verdict is *no effect* if the interval contains zero and two one-sided
tests (5% each; Schuirmann, 1987) reject differences beyond the margin. A claim of no effect is
supported if these tests do so, and contradicted if the interval lies outside the margin. Otherwise
the verdict is *undecided*: there are too few seeds, or they differ too much. Only cells that
undecided comparisons needed got more seeds, and rare failures show mostly in these. So if a side
has failures, its interval also contains the one with the same number of seeds in all of its cells.
A claim with several comparisons has the verdict of the worst comparison.

The values are returns for the rover, and normalised returns of the current settings for the
pendulum, as means over the window lengths that all sides of a comparison have. The trainings of a
comparison count as independent; each window length has a variance of its own, since the seeds of
short windows differ most. Trainings with the same seed are a little alike, at other lengths and of
other agents: claims.json has both correlations. The first makes a mean less certain than its
interval says; the second makes a difference more certain. For iteration times, rounds of the
benchmark replace seeds. Some cells got more seeds after an undecided test; the intervals are wider
for each further test of a comparison (Bonferroni), also for window lengths that were added to claim
11 after such a test. There is no correction for the other tests of the grid while it grows.

`h-td3` has settings of its own, among them twice the steps and an update after each step: claim 7
compares it with `td3` that has as many steps (the table in pendulum_longer), and claim 9 compares
tuned agents, not equal numbers of updates.

An agent learns faster than another if it has the higher mean over all evaluations of its first
30,000 steps (`h-td3`, which trains for 60,000, too); only window lengths with which both end alike
count. Returns fall late in training if the mean of the third fifth of the evaluations is higher
than that of the last fifth. The script writes claims.md and .parquet.
"""

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Callable

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.study.presets import PENDULUM_STEPS_FACTOR

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from claim_tables import Cells, Results, Trainings, compare  # noqa: E402
from effects import CONFIDENCE, ROVER_MARGIN, Effect, Equal, combine  # noqa: E402
from pendulum_cells import CLEAN_NOISE, HARD_BIAS, HISTORIES  # noqa: E402
from writing import RESULTS, markdown_table, provenance, write_results  # noqa: E402

PARTIAL = ("temporal-sine", "random-sine", "noise", "hidden")
HARD_NOISE = "noise:sigma=1.0"
LSTM_AGENTS = [a for a in rtd.ALGORITHMS if a.startswith("lstm")]
RECURRENT = [*LSTM_AGENTS, "h-td3"]
"""All agents with an LSTM layer."""
BEST = "lstm-td3-1ha1hc"
ADDED_LENGTHS = {"lstm-td3": 1, "lstm-td3-no-action": 2}
"""Window lengths that were added to a comparison of claim 11 because it was undecided."""
WHOLE, MIDDLE, LATE = (0.0, 1.0), (0.4, 0.6), (0.8, 1.0)
"""Parts of the training, for the clauses on its course."""
ALIKE = 0.05
"""Largest difference of final returns at which the mean during the training compares the speed."""


def history_is_nothing(disturbance: str) -> Callable[[Results], list[Effect]]:
    """The comparison of claims 1 and 2: past actions make no difference."""
    return lambda results: history_helps(results.pendulum, disturbance, Equal)


def history_helps(
    trainings: Trainings, disturbance: str, kind: type[Effect] = Effect
) -> list[Effect]:
    """The comparison of agents with and without past actions."""
    with_actions, without = (trainings.of(agent, disturbance) for agent in HISTORIES)
    name = " over ".join(HISTORIES)
    return [compare(name, [with_actions], [without], kind)]


def length_helps(
    trainings: Trainings, disturbance: str, kind: type[Effect] = Effect
) -> list[Effect]:
    """The comparison of the longest window with the shortest, with and without past actions."""
    found = []
    for agent in HISTORIES:
        cells = trainings.of(agent, disturbance)
        long, short = max(cells, default=0), min(cells, default=0)
        if long == short:  # without a comparison, the claim is undecided
            found.append(kind(f"{agent}, longest over shortest window", [], []))
        else:
            found.append(kind(f"{agent}, l={long} over l={short}", cells[long], cells[short]))
    return found


def temporal_sine(results: Results) -> list[Effect]:
    """The comparisons of claim 3."""
    trainings = results.pendulum
    return history_helps(trainings, "temporal-sine") + length_helps(trainings, "temporal-sine")


def noise(results: Results) -> list[Effect]:
    """The comparisons of claim 5."""
    trainings = results.pendulum
    found = [
        dataclasses.replace(effect, name=f"sigma {sigma}: {effect.name}")
        for sigma, name in (("0.5", "noise"), ("1.0", HARD_NOISE))
        for effect in (*history_helps(trainings, name), *length_helps(trainings, name))
    ]
    for agent in HISTORIES:
        small, large = (trainings.of(agent, name) for name in ("noise", HARD_NOISE))
        found.append(compare(f"{agent}, sigma 0.5 over 1.0", [small], [large]))
    for agent in HISTORIES:
        middle, late = (results.during(*part).of(agent, "noise") for part in (MIDDLE, LATE))
        name = f"{agent}, middle over end of the training"
        found.append(compare(name, [middle], [late], paired=True))
    return found


def hidden(results: Results) -> list[Effect]:
    """The comparisons of claim 6."""
    trainings = results.pendulum
    final = history_helps(trainings, "hidden", Equal) + length_helps(trainings, "hidden", Equal)
    return [*final, learns_faster(results, "hidden", *HISTORIES)]


def learns_faster(results: Results, disturbance: str, faster: str, slower: str) -> Effect:
    """The comparison of mean returns during the training, at lengths with which both end alike."""
    ends = [results.pendulum.of(agent, disturbance) for agent in (faster, slower)]
    alike = [
        length
        for length in ends[0].keys() & ends[1].keys()
        if abs(ends[0][length].mean() - ends[1][length].mean()) <= ALIKE
    ]
    learning = [results.during(*WHOLE).of(agent, disturbance) for agent in (faster, slower)]
    name = f"{disturbance}, mean return during the training: {faster} over {slower}"
    return compare(name, *([cells] for cells in learning), lengths=alike)


def memory_helps(results: Results) -> list[Effect]:
    """Claim 7: each agent beats `td3`, and by more under `noise` and `hidden` than under sines.

    `h-td3` is compared with `td3` that has as many steps.
    """

    def td3_beside(agent: str, disturbance: str) -> Cells:
        trainings = results.longer if agent in PENDULUM_STEPS_FACTOR else results.pendulum
        return trainings.of("td3", disturbance)

    found = []
    for name in PARTIAL:
        for agent in RECURRENT:
            own, td3 = results.pendulum.of(agent, name), td3_beside(agent, name)
            found.append(compare(f"{name}: {agent} over td3", [own], [td3]))
    for agent in RECURRENT:
        hard, sines = ("noise", "hidden"), ("temporal-sine", "random-sine")
        better = [results.pendulum.of(agent, name) for name in hard]
        better += [td3_beside(agent, name) for name in sines]
        worse = [td3_beside(agent, name) for name in hard]
        worse += [results.pendulum.of(agent, name) for name in sines]
        # Each side is a mean of four returns, so the difference is half of that of the differences.
        name = f"{agent} over td3: `noise` and `hidden` over sines"
        found.append(compare(name, better, worse, factor=2.0))
    return found


def one_stream(results: Results) -> list[Effect]:
    """Claim 8: on average over the disturbances; `lstm-td3-1ha2hc` has one stream in its actor."""
    found, one = [], "lstm-td3-1ha2hc"
    others = [(BEST, agent) for agent in rtd.ALGORITHMS if agent != BEST]
    for best, agent in [*others, (one, "lstm-td3")]:
        sides = ([results.pendulum.of(name, under) for under in PARTIAL] for name in (best, agent))
        found.append(compare(f"{best} over {agent}", *sides))
    return found


def stored_carries(results: Results) -> list[Effect]:
    """Claim 9: where the returns match, the mean during the training shows the speed."""
    found = []
    for name in PARTIAL:
        sides = ([results.pendulum.of(agent, name)] for agent in ("lstm-td3", "h-td3"))
        kind = Effect if name == "noise" else Equal
        found.append(compare(f"{name}: lstm-td3 over h-td3", *sides, kind))
        if name != "noise":
            found.append(learns_faster(results, name, "lstm-td3", "h-td3"))
    return found


def iteration_time(results: Results) -> list[Effect]:
    """Claim 10: the rate at every length, and the share of it that the longest window keeps."""
    found, lengths = [], (1, 3, 6, 10, 20)
    for agent in LSTM_AGENTS:
        found += [
            Effect(
                f"seed-steps/s at l={n}: h-td3 over {agent}",
                results.rates("h-td3", n),
                results.rates(agent, n),
            )
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
    """Claim 11: policies trained under `random-sine` carry over to three conditions, not to noise.

    Noise is also more difficult than the other conditions. So agents that were trained under noise
    are compared with the agents of `random-sine`, both under noise: the difference is the cost of
    moving. Both learned from rewards without noise, because noisy rewards make worse agents. If
    noise is an exception, moving costs more there than under a bias.
    """
    found = []
    for agent in RECURRENT:
        noisy = results.carried.of(agent, HARD_NOISE)
        for condition in ("combined-sine", "damped-sine", HARD_BIAS):
            name = f"{agent}: {condition.partition(':')[0]} over noise"
            found.append(
                compare(name, [results.carried.of(agent, condition)], [noisy], paired=True)
            )
    for agent in HISTORIES:
        noisy, biased = (results.pendulum.of(agent, name) for name in (CLEAN_NOISE, HARD_BIAS))
        to_noise, to_bias = (results.carried.of(agent, name) for name in (HARD_NOISE, HARD_BIAS))
        found.append(
            compare(
                f"{agent}: trained under noise over moved to it",
                [noisy],
                [to_noise],
                other_tests=ADDED_LENGTHS[agent],
            )
        )
        # The moved policies are the same under both conditions. Each side is a mean of two values,
        # so the difference is half of that of the costs.
        more = {n: to_bias[n] - to_noise[n] for n in to_bias.keys() & to_noise.keys()}
        nothing = {n: np.zeros(len(cell)) for n, cell in more.items()}
        found.append(
            compare(
                f"{agent}: the cost of moving, noise over bias",
                [noisy, more],
                [biased, nothing],
                factor=2.0,
            )
        )
    return found


def on_the_rover(name: str, better: np.ndarray, worse: np.ndarray) -> Effect:
    """An effect on the rover's returns, which are not normalised."""
    return Effect(name, better, worse, ROVER_MARGIN, failed=-np.inf)


def agents_beat_td3(results: Results) -> list[Effect]:
    """The comparisons of claim 12."""
    td3 = results.on_rover("td3", "ar1-slip")
    return [on_the_rover(f"{a} over td3", results.on_rover(a, "ar1-slip"), td3) for a in RECURRENT]


def sine_over_none(results: Results) -> list[Effect]:
    """The comparisons of claim 13."""
    return [
        on_the_rover(
            f"{a}, sine over none", results.on_rover(a, "sine-slip"), results.on_rover(a, "none")
        )
        for a in rtd.ALGORITHMS
    ]


def best_transfer(results: Results) -> list[Effect]:
    """The comparisons of claim 14."""
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
    (4, "`random-sine`: action history helps", lambda r: history_helps(r.pendulum, "random-sine")),
    (
        5,
        "`noise`: action history helps, a larger sigma hurts, longer windows help; returns fall "
        "late in training",
        noise,
    ),
    (6, "`hidden`: the final return depends on neither; action history learns faster", hidden),
    (
        7,
        "every agent with an LSTM beats `td3` under partial observability, most under `noise` and "
        "`hidden`",
        memory_helps,
    ),
    (8, "one stream beats two; `lstm-td3-1ha1hc` is the most robust", one_stream),
    (9, "`h-td3` matches `lstm-td3` except under `noise`, and learns more slowly", stored_carries),
    (10, "`h-td3` has the shortest iteration, least sensitive to the window", iteration_time),
    (11, "agents trained on `random-sine` carry over, except to `noise`", carries_over),
    (12, "rover on AR(1) slip: every agent with an LSTM beats `td3`", agents_beat_td3),
    (13, "training on sine slip transfers far better than training without slip", sine_over_none),
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
                "effects": "\n".join(line for e in there for line in listed(e)) or "not run yet",
            }
        )
    return pd.DataFrame(rows)


def listed(effect: Effect) -> list[str]:
    """Items of a Markdown list: the effect, and its parts below it."""
    return [f"- {effect.text()}", *(f"  - {part.text()}" for part in effect.parts)]


def markdown(table: pd.DataFrame) -> str:
    """A line per claim, and a folded list of its comparisons."""
    lines = markdown_table(
        [
            "",
            "the paper's claim",
            "verdict",
            "comparisons: difference of means [95% interval, wider if tested again]",
        ],
        [[str(row.claim), row.text, row.verdict, row.summary] for row in table.itertuples()],
    )
    folded = [
        f"<details><summary>{row.claim}. {row.text}</summary>\n\n" + row.effects + "\n\n</details>"
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
        correlation_of_a_seed_at_two_lengths=results.pendulum.likeness("history_length"),
        correlation_of_a_seed_of_two_agents=results.pendulum.likeness("algorithm"),
    )
    write_results(options.out, "claims", table, text, facts)
    print(text)


if __name__ == "__main__":
    main()
