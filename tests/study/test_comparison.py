"""Compares the comparison of runs with results by hand, and tests its command."""

import re
import sys
import types

import numpy as np
import pandas as pd
import pytest
from random_policies import random_policy
from scipy import stats

import rtd3jax as rtd
from rtd3jax import compare as command
from rtd3jax.study.cells import Cell, Grid, make_cells
from rtd3jax.study.comparison import compare_runs, differing_settings
from rtd3jax.study.derive import derive
from rtd3jax.study.plants import differing_plants
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.statistics import compare


def test_differences_are_paired_where_seeds_are_equal():
    x = {0: 1.0, 1: 20.0, 2: 300.0, 5: np.nan}
    y = {2: 303.0, 1: 21.0, 0: 3.0, 7: -1e6, 5: 1.0}
    found = compare(x, y)
    assert (found.pairs, found.difference) == (3, pytest.approx(2.0))  # 2, 1 and 3
    assert 1.0 <= found.difference_low < 2.0 < found.difference_high <= 3.0
    wins = [3 > 1, 21 > 1, 303 > 1, 21 > 20, 303 > 20, 303 > 300]  # of 5 seeds against 3; one tie
    assert found.improvement == pytest.approx((sum(wins) + 0.5) / 15)
    assert 0 <= found.improvement_low < found.improvement < found.improvement_high <= 1


def test_other_seeds_are_compared_by_their_means():
    chance = np.random.default_rng(0)
    x = dict(enumerate(chance.normal(0, 1, 40)))
    y = {100 + seed: value for seed, value in enumerate(chance.normal(1, 2, 30))}
    found = compare(x, y)
    first, second = np.array(list(x.values())), np.array(list(y.values()))
    assert found.pairs == 0 and found.difference == pytest.approx(second.mean() - first.mean())
    expected = stats.bootstrap(
        (second, first),
        lambda a, b, axis: a.mean(axis=axis) - b.mean(axis=axis),
        method="percentile",
        rng=np.random.default_rng(1),
    ).confidence_interval
    ends = found.difference_low, found.difference_high
    np.testing.assert_allclose(ends, (expected.low, expected.high), atol=0.06)
    chances = [
        np.mean(chance.choice(second, 30)[:, None] > chance.choice(first, 40)[None])
        for _ in range(4_000)
    ]
    ends = found.improvement_low, found.improvement_high
    np.testing.assert_allclose(ends, np.quantile(chances, [0.025, 0.975]), atol=0.02)


def test_one_seed_has_no_interval_and_none_no_difference():
    found = compare({0: 1.0}, {0: 2.0})
    assert (found.difference, found.improvement) == (1.0, 1.0)
    assert np.isnan([found.difference_low, found.improvement_high]).all()
    assert np.isnan(compare({0: np.nan}, {0: 2.0}).difference)


def make_run(out, grid, better, seeds=(0, 1, 2), **settings):
    """A finished run of untrained agents; seed s has return s + ``better``, truly 10 more."""
    fields = {"total_steps": 60, "hidden_size": 8, "eval_every": 60, "batch_size": 8}
    fields |= {"learning_starts": 10, **settings}
    directory = RunDirectory.create(out, make_cells([grid], fields), list(seeds), 2)
    for cell in directory.cells:
        policy = random_policy(cell.config.algorithm, cell.make_env())
        for seed in directory.seeds:
            final = np.array([seed - 1.0, seed + 1.0]) + better
            curves = {"steps": np.array([60]), "returns": final[:1], "true_returns": final[:1]}
            curves |= {"final_returns": final, "final_true_returns": final + 10}
            interface = policy.interface()
            directory.lanes.write_lane(cell, seed, policy.parameters(), curves, {}, None, interface)
    derive(directory, [], pictures=False)
    return str(out)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    top = tmp_path_factory.mktemp("runs")
    rover = Grid("rover", ("none", "ar1-slip"), ("td3",), (1,))
    one = Grid("rover", ("ar1-slip",), ("td3",), (1,))
    pendulum = Grid("pendulum", ("none",), ("td3",), (1,))
    return {
        "before": make_run(top / "a" / "run", rover, 0.0),
        "after": make_run(top / "b" / "run", one, 0.5, seeds=range(4), gamma=0.9),
        "elsewhere": make_run(top / "c", pendulum, 0.0),
    }


def test_the_command_prints_and_keeps_the_table(runs, tmp_path, capsys):
    out = tmp_path / "compared"
    assert command.main([runs["before"], runs["after"], "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert (out / "compare.md").read_text() in printed
    assert "## rover, ar1-slip" in printed and "## rover, none" not in printed
    # Of seeds 0 to 2 each is better by 0.5; of 12 pairs of any seeds, 3 + 2 + 1 + 3 are won.
    assert "| td3 | 0 | a/run | 3 | 1 [0, 2] | – | – | – |" in printed
    assert "| 0.5 [0.5, 0.5] | 3 | 0.75 [" in printed
    assert "- differs: gamma: 0.99 (a/run), 0.9 (b/run)\n\n" in printed
    assert printed.count("- differs") == 1
    table = pd.read_parquet(out / "compare.parquet")
    assert table["run"].tolist() == ["a/run", "b/run"] and table["pairs"].tolist() == [0, 3]
    assert table["mean"].tolist() == [1.0, 2.0] and np.isnan(table["difference"][0])
    assert command.main([runs["before"], runs["after"], "--true-return"]) == 0
    assert "| td3 | 0 | a/run | 3 | 11 [10, 12] |" in capsys.readouterr().out


def test_settings_are_compared_cell_by_cell():
    """Cells of one run may have different settings, and come in any order."""
    names = ["a", "b", "c"]
    steps = {"td3": (200, 200, 200), "lstm-td3": (200, 400, None), "h-td3": (400, 400, 400)}
    directories = [
        types.SimpleNamespace(
            cells=[
                Cell("rover", "none", rtd.Config(algorithm=agent, total_steps=own[run]))
                for agent, own in list(steps.items())[:: -1 if run else 1]
                if own[run]
            ],
            episodes=2,
            known_plants=dict,
        )
        for run in range(3)
    ]
    table = pd.DataFrame([cell.key for cell in directories[0].cells])
    found = differing_settings(directories, names, table)
    where = "(1 of 3 cells: lstm-td3)"
    assert found == [
        f"total_steps {where}: 200 (a), 400 (b)",
        f"replay_capacity {where}: 200 (a), 400 (b)",
    ]


def test_runs_of_another_plant_with_the_same_name_differ():
    plant = {"params": [1.0, 9.8], "names": ["mass", "g"], "actions": 1, "code": None}
    before = {"own none": plant, "own noise": plant}
    now = {"own none": {**plant, "params": [2.0, 9.8]}, "own delay": plant}
    assert differing_plants(before, before) == []
    (text,) = differing_plants(before, now)
    assert text == "own none (mass: 1.0 there, 2.0 here)"
    # Studies of earlier versions do not state the names.
    for old, new in ((0, 1), (1, 0), (0, 0)):
        sides = before["own none"], now["own none"]
        stated = [
            {name: part for name, part in side.items() if named or name != "names"}
            for side, named in zip(sides, (old, new), strict=True)
        ]
        (text,) = differing_plants({"own none": stated[0]}, {"own none": stated[1]})
        assert "1.0" in text and "2.0" in text


def test_the_first_run_is_what_others_are_compared_with(runs):
    both = [RunDirectory.open(runs[name]) for name in ("after", "before")]
    table = compare_runs(both, ["after", "before"])
    assert table["difference"].tolist()[1] == pytest.approx(-0.5)


@pytest.mark.parametrize(
    ("chosen", "match"),
    [
        (
            ("before", "elsewhere"),
            "run has no finished cell .* run has rover .* c has pendulum",
        ),
        (("before",), "compare needs at least two runs"),
        (("before", "before"), "is given twice"),
    ],
)
def test_what_cannot_be_compared_is_one_line(runs, chosen, match, capsys):
    assert command.main([runs[name] for name in chosen]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(match, error), error


def test_a_run_without_results_and_no_run_are_one_line(runs, tmp_path, capsys):
    cells = make_cells([Grid("rover", ("ar1-slip",), ("td3",), (1,))], {})
    RunDirectory.create(tmp_path / "planned", cells, [0], 2)
    for other, match in (("planned", "has no results yet"), ("nothing", "nothing")):
        assert command.main([runs["before"], str(tmp_path / other)]) == 2
        error = capsys.readouterr().err
        assert match in error and error.count("\n") == 1
    file = tmp_path / "file"
    file.write_text("")
    assert command.main([runs["before"], runs["after"], "--out", str(file)]) == 2
    assert "is a file: --out must name a directory" in capsys.readouterr().err


def test_agents_of_a_module_can_be_imported(runs, tmp_path, monkeypatch):
    (tmp_path / "own_agents.py").write_text("LOADED = True\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    chosen = [runs["before"], runs["after"], "--import", "own_agents"]
    assert command.main(chosen) == 0 and sys.modules.pop("own_agents").LOADED
