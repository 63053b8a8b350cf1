"""Tests the robustness of a run: its command, table, picture and charts."""

import shutil

import numpy as np
import pandas as pd
import pytest
from browser import chromium
from made_run import make_run
from test_report import data_of

import rtd3jax as rtd
from rtd3jax import stress
from rtd3jax.envs.description import Ceiling
from rtd3jax.study import ceilings
from rtd3jax.study.cells import Grid
from rtd3jax.study.report.page import page_data
from rtd3jax.study.robustness import over_seeds
from rtd3jax.study.rundir import RunDirectory

GRID = Grid("rover", ("ar1-slip:max_steps_in_episode=10",), ("td3", "lstm-td3-1ha1hc"), (2,))
STRESSES = ["slip=0,0.4,0.8", "delay=0,2"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of untrained agents that was tested."""
    out = tmp_path_factory.mktemp("robustness") / "rover"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ceilings, "ceiling", lambda env, **_: Ceiling(-1.2, 0.1, "exact"))
        make_run(out, GRID)
        assert stress.main([str(out), "--episodes", "3", "--stresses", *STRESSES]) == 0
    return out


def test_the_table_holds_what_each_policy_does(run):
    table = pd.read_parquet(run / "robustness.parquet")
    directory = RunDirectory.open(run)
    assert len(table) == 2 * 2 * 5
    for cell in directory.cells:
        for seed in directory.seeds:
            policy, env = directory.lanes.policy(cell, seed), cell.make_env()
            own = table[(table["algorithm"] == cell.config.algorithm) & (table["seed"] == seed)]
            expected = rtd.robustness(policy, env, STRESSES, episodes=3, seed=seed)
            for name in ("stress", "value", "return", "true_return", "standard_error"):
                assert own[name].tolist() == expected[name].tolist()
            still = own[(own["stress"] == "delay") & (own["value"] == 0)]["return"].item()
            plain = float(rtd.evaluate(policy, env, 3, seed).mean())
            assert still == pytest.approx(plain, rel=1e-5)


def test_the_picture_shows_means_over_seeds(run):
    table = pd.read_parquet(run / "robustness.parquet")
    means = over_seeds(table)
    assert list(dict.fromkeys(means["policy"])) == ["td3", "lstm-td3-1ha1hc"]
    for _, row in means.iterrows():
        same = table[["algorithm", "stress", "value"]] == [
            row["policy"],
            row["stress"],
            row["value"],
        ]
        seeds = table[same.all(axis=1)]["return"]
        assert row["return"] == pytest.approx(seeds.mean())
        assert row["standard_error"] == pytest.approx(seeds.std() / 2**0.5)
    two = pd.concat([table, table[table["history_length"] == 2].assign(history_length=5)])
    names = ["td3", "lstm-td3-1ha1hc, history 2", "lstm-td3-1ha1hc, history 5"]
    assert list(dict.fromkeys(over_seeds(two)["policy"])) == names
    name = "robustness_rover_ar1-slip-max_steps_in_episode=10.png"
    assert (run / name).read_bytes().startswith(b"\x89PNG")


def test_the_page_has_a_chart_for_each_stress(run):
    data = data_of(run)
    assert data["notes"] == []
    table = pd.read_parquet(run / "robustness.parquet")
    assert [(entry["cell"], entry["stress"]) for entry in data["robustness"]] == [
        (0, "slip"),
        (0, "delay"),
        (1, "slip"),
        (1, "delay"),
    ]
    for entry in data["robustness"]:
        agent = data["agents"][data["cells"][entry["cell"]]["agent"]]["name"]
        own = table[(table["algorithm"] == agent) & (table["stress"] == entry["stress"])]
        means = own.groupby("value")["return"].mean()
        curve = entry["curves"]["return"]
        assert curve["steps"] == means.index.tolist() and curve["seeds"] == [2] * len(means)
        assert curve["iqm"] == pytest.approx(means.tolist(), rel=1e-4)
        assert all(np.array(curve["low"]) <= np.array(curve["high"]))


def test_in_a_browser(run):
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1200, "height": 900})
        troubles = []
        page.on("console", lambda message: troubles.append(message.text))
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.goto((run / "report.html").as_uri())
        section = page.locator("#robustness")
        assert section.locator("figcaption").all_inner_texts() == ["slip", "delay"]
        assert section.locator(".agent-line").count() == 4
        assert section.locator(".quantity").first.inner_text() == "constant slip of both wheels"
        plot = section.locator("svg.plot").first
        plot.focus()
        plot.press("ArrowLeft")
        assert "constant slip of both wheels 0.4" in page.locator("#tip").inner_text()
        page.locator("#filters label", has_text="td3").first.click()
        assert section.locator(".agent-line").count() == 2
        page.set_viewport_size({"width": 375, "height": 700})
        page.wait_for_timeout(300)
        assert page.evaluate("document.documentElement.scrollWidth") <= 375
        assert troubles == []


def test_mistakes_are_one_line(run, tmp_path, capsys):
    def message(*arguments):
        assert stress.main(list(arguments)) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1
        return error

    assert "did you mean 'slip'" in message(str(run), "--stresses", "silp")
    assert "p=1.5 must be at most 1" in message(str(run), "--stresses", "dropout=1.5")
    assert "episodes must be" in message(str(run), "--episodes", "0")
    assert "there is no study" in message(str(tmp_path / "nowhere"))
    (tmp_path / "config.json").write_bytes((run / "config.json").read_bytes())
    assert "has no finished lane" in message(str(tmp_path))


def test_a_lost_lane_does_not_stop_the_others(run, tmp_path, capsys):
    shutil.copytree(run, tmp_path / "run")
    directory = RunDirectory.open(tmp_path / "run")
    (cell, *_), (seed, *_) = directory.cells, directory.seeds
    policy, path = directory.lanes.policy(cell, seed), directory.lanes.lane_path(cell, seed)
    failure = {"step": 3, "reason": "the critic loss is NaN"}
    directory.lanes.write_lane(cell, seed, policy.parameters(), {}, {}, failure)
    assert path.exists() and directory.lanes.is_lost(cell, seed)
    options = ["--episodes", "3", "--stresses", "delay=0,2,2.0"]
    assert stress.main([str(tmp_path / "run"), *options]) == 0
    assert "seed 0 was lost in training: the critic loss is NaN" in capsys.readouterr().out
    table = pd.read_parquet(tmp_path / "run" / "robustness.parquet")
    assert len(table) == 3 * 2  # three lanes; 2 and 2.0 are one value


def test_a_damaged_lane_does_not_take_the_others_from_the_page(run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    directory = RunDirectory.open(tmp_path / "run")
    damaged = directory.lanes.lane_path(directory.cells[0], 1)
    damaged.write_bytes(damaged.read_bytes()[:-1])
    data = page_data(directory, complete=False, playback=False)
    assert [(entry["cell"], entry["stress"]) for entry in data["robustness"]] == [
        (0, "slip"),
        (0, "delay"),
        (1, "slip"),
        (1, "delay"),
    ]
    assert any(damaged.name in note for note in data["notes"])
