"""Tests the verdicts on the paper's claims: intervals, comparisons, and what the tables say."""

import dataclasses
import pathlib
import sys

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from test_reliability import EXPERIMENTS, load

pytestmark = pytest.mark.usefixtures("leave_the_path_alone")


def test_verdicts_follow_from_the_numbers():
    claims = load(EXPERIMENTS / "claims.py")
    good, bad = np.array([-1.3, -1.31, -1.29]), np.array([-2.9, -3.0, -2.8])
    wide = np.array([-1.0, -3.0, -2.0])
    assert claims.Effect("", good, bad).verdict() == "supported"
    assert claims.Effect("", bad, good).verdict() == "contradicted"
    assert claims.Effect("", good, wide).verdict() == "undecided"
    assert claims.Effect("", good[:2], bad).verdict() == "undecided"
    level = np.array([-1.300, -1.301, -1.299])
    assert claims.Effect("", level, level[::-1]).verdict() == "no effect"
    assert "no effect beyond ±0.00" in claims.Effect("", level, level[::-1]).text()
    assert claims.Effect("", level, level[::-1], margin=0.0).verdict() == "undecided"
    assert claims.combine(["supported", "undecided", "no effect"]) == "undecided"
    assert claims.combine(["supported", "no effect"]) == "no effect"
    assert claims.combine(["supported", "contradicted"]) == "contradicted"
    assert claims.combine([]) == "undecided"
    mean, low, high = claims.Effect("", good, bad).interval()
    assert mean == pytest.approx(1.6) and low < mean < high


def test_intervals_cover_as_often_as_they_say():
    """Of five normal values on each side, as often as of many; a bootstrap covers 87%."""
    effects = load(EXPERIMENTS / "effects.py")
    chance = np.random.default_rng(0)
    for paired in (False, True):
        inside = []
        for _ in range(2_000):
            sides = chance.normal(0, 1, 5), chance.normal(0, 1, 5)
            _, low, high = effects.Effect("", *sides, paired=paired).interval()
            inside.append(low <= 0 <= high)
        # Welch's interval is a little too wide with so few values.
        assert 0.94 < np.mean(inside) < 0.975


def test_intervals_are_those_of_scipy():
    effects = load(EXPERIMENTS / "effects.py")
    one, other = np.array([0.9, 0.94, 0.92, 0.99]), np.array([0.7, 0.95, 0.8])
    for paired, test in ((False, stats.ttest_ind), (True, stats.ttest_rel)):
        sides = (one[:3], other) if paired else (one, other)
        found = test(*sides, **({} if paired else {"equal_var": False}))
        expected = found.confidence_interval(0.95)
        assert effects.Effect("", *sides, paired=paired).interval()[1:] == pytest.approx(expected)
    # Two one-sided tests: the bound is where the p-value of the weaker one is 5%.
    bound = effects.Effect("", one, other).bound()
    weaker = stats.ttest_ind(one, other + bound, equal_var=False, alternative="less")
    assert weaker.pvalue == pytest.approx(0.05)


def test_cells_count_equally_whatever_their_seeds():
    """Against simulations: cells of a grid with different spreads and numbers of seeds."""
    effects = load(EXPERIMENTS / "effects.py")
    chance = np.random.default_rng(0)
    cells = [(0.0, 1.0, 15), (3.0, 0.1, 5)]  # mean, standard deviation, seeds
    other = [(1.0, 0.5, 5)]
    found = []
    for _ in range(2_000):
        better, worse = (
            [chance.normal(mean, spread, seeds) for mean, spread, seeds in side]
            for side in (cells, other)
        )
        found.append(effects.Effect("", better, worse, failed=-np.inf).interval())
    middle, low, high = np.transpose(found)
    assert middle.mean() == pytest.approx((0.0 + 3.0) / 2 - 1.0, abs=0.02)
    # A cell with 15 seeds was tested twice, so the error is half as large.
    assert 0.967 < np.mean((low <= 0.5) & (high >= 0.5)) < 0.983
    effect = effects.Effect("", [np.zeros(15), np.zeros(2)], worse[0])
    assert effect.seeds() == (2, 5) and effect.verdict() == "undecided"
    assert effect.text() == ": too few seeds (2, 5)"
    assert effects.Effect("", [], worse).seeds() == (0, 5)


def test_parts_of_a_side_count_equally_whatever_their_cells():
    effects = load(EXPERIMENTS / "effects.py")
    two, one, three = [np.zeros(5), np.full(5, 0.4)], np.ones(3), [np.full(4, k) for k in range(3)]
    assert [weight for weight, _ in effects.cells_of([two, one])] == [0.25, 0.25, 0.5]
    effect = effects.Effect("", [two, one], [three, one], factor=2.0)
    assert effect.interval() == pytest.approx((2 * (0.6 - 1.0),) * 3)
    assert effect.seeds() == (3, 3)


def test_paired_cells_are_compared_within_their_pairs():
    """What both values of a pair have in common does not widen the interval."""
    effects = load(EXPERIMENTS / "effects.py")
    chance = np.random.default_rng(0)
    common = [chance.normal(0, 10, seeds) for seeds in (5, 15)]
    own = [chance.normal(1, 0.1, len(cell)) for cell in common]
    better = [cell + more for cell, more in zip(common, own, strict=True)]
    found = effects.Effect("", better, common, paired=True, failed=-np.inf).interval()
    assert found == pytest.approx(effects.Effect("", own, [np.zeros(5), np.zeros(15)]).interval())
    mean, low, high = effects.Effect("", better, common).interval()
    assert mean == pytest.approx(found[0]) and high - low > 20 * (found[2] - found[1])


def test_trainings_with_the_same_seed_are_compared_with_each_other():
    tables = load(EXPERIMENTS / "claim_tables.py")
    chance = np.random.default_rng(0)
    seeds, rows = chance.normal(size=200), []
    for length, like in ((1, 1.0), (6, 1.0), (20, 0.0)):
        values = 5 * length + like * seeds + chance.normal(0, 1.0, 200)
        for seed, value in enumerate(values):
            row = {"history_length": length, "seed": seed, "normalised": value}
            rows.append({"algorithm": "lstm-td3", "disturbance": "noise", **row})
    table = pd.DataFrame(rows)
    near = table[table["history_length"] != 20]
    assert tables.Trainings(near).likeness("history_length") == pytest.approx(0.5, abs=0.1)
    far = table[table["history_length"] != 1]
    assert tables.Trainings(far).likeness("history_length") == pytest.approx(0.0, abs=0.1)
    assert tables.Trainings(near).likeness("algorithm") is None
    assert tables.Trainings(pd.DataFrame()).likeness("algorithm") is None


def test_claims_without_results_are_undecided(tmp_path, capsys):
    load(EXPERIMENTS / "claims.py").main(["--results", str(tmp_path), "--out", str(tmp_path)])
    table = pd.read_parquet(tmp_path / "claims.parquet")
    assert len(table) == 15 and set(table["verdict"]) == {"undecided"}
    assert capsys.readouterr().out.count("not run yet") == 15


def test_a_claim_of_no_effect_needs_a_narrow_interval():
    claims = load(EXPERIMENTS / "claims.py")
    one = np.array([0.900, 0.902, 0.904])
    assert claims.Equal("", one, one + 0.01).verdict() == "supported"
    assert claims.Equal("", one, one + 0.2).verdict() == "contradicted"
    assert claims.Equal("", one, np.array([0.6, 0.9, 1.2])).verdict() == "undecided"
    assert claims.Equal("", one[:2], one).verdict() == "undecided"


PARTIAL = ("temporal-sine", "random-sine", "noise", "hidden")
LEVEL = {"td3": 0.2, "lstm-td3": 0.6, "lstm-td3-no-action": 0.5, "lstm-td3-1ha1hc": 0.8}
LEVEL |= {"lstm-td3-1ha2hc": 0.7, "h-td3": 0.6}


def pendulum_lanes() -> list[dict]:
    """Rows of a table in which the agents have the given returns, td3 less under two conditions."""
    return [
        {
            "algorithm": agent,
            "disturbance": disturbance,
            "history_length": length,
            "seed": seed,
            "normalised": value
            + 0.002 * (seed - 2)
            + 0.01 * length
            - 0.1 * (agent == "td3" and disturbance in PARTIAL[2:]),
        }
        for agent, value in LEVEL.items()
        for disturbance in PARTIAL
        for length in ((0,) if agent == "td3" else (1, 6))
        for seed in range(5)
    ]


def verdicts_of(tables: dict[str, list[dict]], directory: pathlib.Path) -> pd.Series:
    """The verdict of each claim on these tables."""
    for name, rows in tables.items():
        (directory / name).parent.mkdir(exist_ok=True)
        pd.DataFrame(rows).to_parquet(directory / f"{name}.parquet")
    directories = ["--results", str(directory), "--out", str(directory)]
    load(EXPERIMENTS / "claims.py").main(directories)
    return pd.read_parquet(directory / "claims.parquet").set_index("claim")["verdict"]


def test_the_pendulums_claims_follow_from_its_tables(tmp_path):
    lanes = pendulum_lanes()
    # h-td3 is only compared with td3 that has as many steps.
    assert verdicts_of({"pendulum": lanes}, tmp_path)[7] == "undecided"
    longer = {"pendulum_longer/pendulum": [e for e in lanes if e["algorithm"] == "td3"]}
    verdicts = verdicts_of({"pendulum": lanes, **longer}, tmp_path)
    assert list(verdicts[[3, 4, 7, 8]]) == ["supported"] * 4
    # With and without action history are 0.1 apart, more than the margin.
    assert verdicts[6] == "contradicted"
    # The speed of learning follows from the curves, which are missing.
    assert verdicts[9] == "undecided"
    assert set(verdicts[[1, 2, 10, 11, 12]]) == {"undecided"}

    # td3's disadvantage is the same under each disturbance.
    level = [
        {**lane, "normalised": lane["normalised"] + 0.1}
        if lane["algorithm"] == "td3" and lane["disturbance"] in ("noise", "hidden")
        else lane
        for lane in lanes
    ]
    longer = {"pendulum_longer/pendulum": [e for e in level if e["algorithm"] == "td3"]}
    assert verdicts_of({"pendulum": level, **longer}, tmp_path)[7] == "no effect"


@pytest.mark.parametrize(
    "steps, rising, verdict",
    [(40, -0.1, "supported"), (20, -0.1, "undecided"), (40, 0.1, "contradicted")],
)
def test_the_claim_on_noise_follows_from_tables_and_curves(tmp_path, steps, rising, verdict):
    """What sigma does is not read off trainings of other lengths; a fall is one of the means."""
    lanes = pendulum_lanes()
    large = {"disturbance": "noise:sigma=1.0", "steps": steps}
    finals = [{**lane, "steps": 40} for lane in lanes]
    finals += [{**lane, **large, "normalised": lane["normalised"] - 0.3} for lane in lanes]
    curves = [
        {**lane, "step": step, "normalised": lane["normalised"] + rising * step / 30_000}
        for lane in lanes
        for step in range(3_000, 31_000, 3_000)
    ]
    assert verdicts_of({"pendulum": finals, "pendulum_curves": curves}, tmp_path)[5] == verdict


def test_speeds_of_learning_are_means_of_common_steps(tmp_path):
    """h-td3's curve is twice as long; a curve that ends early, and a cell of two seeds, are out."""
    tables = load(EXPERIMENTS / "claim_tables.py")
    ends = {("h-td3", 1): 60_000, ("lstm-td3", 1): 30_000, ("lstm-td3", 6): 27_000}
    pd.DataFrame(
        {
            "algorithm": agent,
            "disturbance": "hidden",
            "history_length": length,
            "seed": seed,
            "step": step,
            "normalised": step / 30_000 + seed,
        }
        for (agent, length), end in {**ends, ("td3", 0): 30_000}.items()
        for seed in range(2 if agent == "td3" else 3)
        for step in range(3_000, end + 1, 3_000)
    ).to_parquet(tmp_path / "pendulum_curves.parquet")
    results = tables.Results.read(tmp_path)
    for agent in ("h-td3", "lstm-td3"):
        cells = results.during(0.0, 1.0).of(agent, "hidden")
        assert list(cells) == [1] and cells[1] == pytest.approx(0.55 + np.arange(3))
    assert results.during(0.0, 1.0).of("td3", "hidden") == {}
    late = results.during(0.8, 1.0).of("h-td3", "hidden")
    assert late[1] == pytest.approx(0.95 + np.arange(3))


def test_speeds_are_compared_where_both_agents_end_alike():
    claims, tables = load(EXPERIMENTS / "claims.py"), load(EXPERIMENTS / "claim_tables.py")
    ends = {("lstm-td3", 1): 0.5, ("h-td3", 1): 0.9, ("lstm-td3", 6): 0.97, ("h-td3", 6): 0.96}
    lanes = pd.DataFrame(
        {
            "algorithm": agent,
            "disturbance": "hidden",
            "history_length": length,
            "seed": seed,
            "normalised": end + 0.001 * seed,
        }
        for (agent, length), end in ends.items()
        for seed in range(5)
    )
    curves = [
        lanes.assign(step=step, normalised=lanes["normalised"] * (step == 30_000))
        for step in (15_000, 30_000)
    ]
    none = pd.DataFrame()
    results = tables.Results(
        none, tables.Trainings(lanes), pd.concat(curves), tables.Trainings(none), none
    )
    effect = claims.learns_faster(results, "hidden", "lstm-td3", "h-td3")
    assert effect.name.endswith("(l = 6)") and effect.parts == ()
    assert effect.interval()[0] == pytest.approx(0.005)


def test_intervals_are_wider_if_a_comparison_was_tested_again():
    """Each test has an equal share of the error; what was tested shows in the cells' seeds."""
    effects = load(EXPERIMENTS / "effects.py")
    chance = np.random.default_rng(0)
    for seeds, looks in ((5, 1), (15, 2), (40, 3)):
        better, worse = chance.normal(0.1, 1, seeds), chance.normal(0, 1, 5)
        effect = effects.Effect("", [worse, better], worse)
        assert effect.looks() == looks
        test = stats.ttest_ind(better, worse, equal_var=False)
        expected = test.confidence_interval(1 - 0.05 / looks)
        assert effects.Effect("", better, worse).interval()[1:] == pytest.approx(expected)
        said = {1: "", 2: "twice", 3: "3 times"}[looks]
        assert said in effect.text() and ("tested" in effect.text()) == (looks > 1)
    # Two cells got 40 seeds one after the other; a cell that occurs twice counts once.
    both = effects.Effect("", [better, better], [chance.normal(0, 1, 40), worse])
    assert both.looks() == 4
    assert dataclasses.replace(both, other_tests=2).looks() == 6


def test_rare_failures_count_with_the_same_seeds_in_all_cells():
    """More seeds where trainings failed show neither that agents are equal nor that they differ."""
    effects = load(EXPERIMENTS / "effects.py")
    level = np.full(40, 0.9) + 0.001 * np.sin(np.arange(40))
    failing = np.where(np.arange(40) == 3, -0.2, level)
    cells = [failing, *(level[:5] for _ in range(15))]
    other = [level[:5] for _ in range(16)]
    for kind, good in ((effects.Effect, "no effect"), (effects.Equal, "supported")):
        uneven = kind("", other, cells)
        assert uneven.verdict() == "undecided" and "trainings failed" in uneven.text()
        confidence = 1 - 0.1 / uneven.looks()
        alone, even = (e._single_interval(confidence) for e in (uneven, uneven.even()))
        assert max(np.abs(alone)) < uneven.margin < uneven.bound() == max(np.abs(even))
        assert uneven.even().seeds() == (5, 5)
        # A failure that only later seeds have counts, too.
        late = kind("", other, [failing[::-1], *cells[1:]])
        assert late.interval()[1:] == late._single_interval(1 - 0.05 / late.looks())[1:]
        assert kind("", other, [level, *cells[1:]]).verdict() == good
        assert not kind("", failing, level[:5]).has_failures()
    better = effects.Effect("", other, [cell - 0.02 for cell in cells])
    assert better._single_interval(0.99)[1] > 0 and better.verdict() == "undecided"
    assert not effects.Effect("", other, cells, failed=-np.inf).has_failures()
    assert not effects.Effect("", other, [np.full(40, -0.2), *other[1:]]).has_failures()


def test_comparisons_have_a_part_for_each_length():
    """Without a window an agent counts with each; cells with a single common length have none."""
    tables = load(EXPERIMENTS / "claim_tables.py")
    effects = sys.modules["effects"]
    own = {1: np.full(5, 0.5), 6: np.full(5, 0.9), 20: np.full(5, 1.0)}
    other, none = {1: np.full(5, 0.1), 6: np.full(5, 0.2)}, {0: np.full(5, 0.3)}
    effect = tables.compare("agents", [own], [other], effects.Equal, margin=0.5)
    assert effect.name == "agents (l = 1, 6)" and effect.interval()[0] == pytest.approx(0.55)
    parts = {part.name: part.interval()[0] for part in effect.parts}
    assert parts == pytest.approx({"l = 1": 0.4, "l = 6": 0.7})
    assert {part.verdict() for part in effect.parts} == {"supported", "contradicted"}
    against = tables.compare("agents", [own], [none])
    assert len(against.parts) == 3 and against.interval()[0] == pytest.approx(0.5)
    assert tables.compare("agents", [own], [{6: own[6]}]).parts == ()
    assert tables.compare("agents", [own], [none], lengths=[20]).interval()[0] == pytest.approx(0.7)
    for missing in ({}, {3: own[1]}):
        assert len(tables.compare("agents", [own, own], [own, missing]).better) == 0


def test_agents_of_another_condition_are_compared_with_those_trained_under_it():
    """Claim 11: low returns under noise do not suffice; agents trained under it must have more."""
    claims, tables = load(EXPERIMENTS / "claims.py"), load(EXPERIMENTS / "claim_tables.py")
    conditions = {
        "combined-sine": 0.9,
        "damped-sine": 0.9,
        claims.HARD_BIAS: 0.8,
        claims.HARD_NOISE: 0.3,
    }

    def rows(returns: dict[str, float]) -> pd.DataFrame:
        return pd.DataFrame(
            {
                "algorithm": agent,
                "disturbance": name,
                "history_length": 6,
                "seed": seed,
                "normalised": value + 0.001 * seed,
            }
            for agent in claims.RECURRENT
            for name, value in returns.items()
            for seed in range(5)
        )

    none = pd.DataFrame()
    # Moving to noise costs 0.3 or 0.1, and more or less than moving to a bias.
    cases = ((0.6, 0.9, "supported"), (0.6, 1.2, "contradicted"), (0.1, 0.9, "contradicted"))
    for to_noise, to_bias, verdict in cases:
        there = {claims.CLEAN_NOISE: to_noise, claims.HARD_BIAS: to_bias, claims.HARD_NOISE: -0.2}
        sides = tables.Trainings(rows(there)), none, tables.Trainings(rows(conditions))
        effects = claims.carries_over(tables.Results(none, *sides, none))
        assert claims.combine([effect.verdict() for effect in effects]) == verdict


def test_comparisons_share_their_window_lengths(tmp_path):
    """An agent that is trained with more windows than another is compared at the common ones."""
    claims = load(EXPERIMENTS / "claims.py")
    returns = {("lstm-td3", 6): 0.8, ("lstm-td3", 1): 0.1, ("lstm-td3-no-action", 6): 0.7}
    returns |= {("td3", 0): 0.2, ("lstm-td3", 20): 0.9}
    lanes = [
        {
            "algorithm": agent,
            "disturbance": "temporal-sine",
            "history_length": length,
            "seed": seed,
            "normalised": value,
        }
        for (agent, length), value in returns.items()
        for seed in range(5)
    ]
    pd.DataFrame(lanes).to_parquet(tmp_path / "pendulum.parquet")
    results = claims.Results.read(tmp_path)
    effects = claims.temporal_sine(results) + claims.memory_helps(results)[:2]
    found = {effect.name: effect.interval()[0] for effect in effects if len(effect.better)}
    assert found == pytest.approx(
        {
            "lstm-td3 over lstm-td3-no-action (l = 6)": 0.1,
            "lstm-td3, l=20 over l=1": 0.8,
            "temporal-sine: lstm-td3 over td3 (l = 1, 6, 20)": 0.6 - 0.2,
            "temporal-sine: lstm-td3-no-action over td3 (l = 6)": 0.5,
        }
    )
