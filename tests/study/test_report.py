"""Tests the page of a run: its data, its behaviour in a browser, its notes."""

import json
import os
import re
import shutil

import numpy as np
import pandas as pd
import pytest
from browser import chromium
from made_run import STEPS, make_run

import rtd3jax as rtd
from rtd3jax import report, stress, transfer
from rtd3jax.envs.description import Ceiling
from rtd3jax.study import ceilings
from rtd3jax.study.cells import Grid
from rtd3jax.study.report.page import page_data
from rtd3jax.study.report.playback import record_episodes
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import read_arrays, write_arrays

AGENTS = ("td3", "lstm-td3-1ha1hc")
GRIDS = {
    "rover": Grid("rover", ("ar1-slip", "sine-slip+dropout:p=0.3"), AGENTS, (1, 2)),
    "pendulum": Grid("pendulum", ("random-sine",), AGENTS, (1, 2)),
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A small run of each environment, with its page and (rover) its transfer matrix."""
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        best = Ceiling(-1.2, 0.1, "upper bound")
        patch.setattr(ceilings, "ceiling", lambda env, **_: best)  # the pendulum's takes seconds
        for env, grid in GRIDS.items():
            out = found[env] = tmp_path_factory.mktemp("page") / env
            make_run(out, grid)
            assert report.main([str(out)]) == 0
        on = GRIDS["rover"].disturbances[1]
        assert transfer.main([str(found["rover"]), "--episodes", "2", "--on", on]) == 0
    return found


def data_of(run):
    text = (run / "report.html").read_text()
    return json.loads(re.search(r'id="data">(.*?)</script>', text, re.S)[1])


def rows_of(table, key):
    return table[(table[list(key)] == list(key.values())).all(axis=1)]


def test_the_numbers_are_those_of_the_tables(runs):
    data = data_of(runs["rover"])
    assert data["notes"] == [] and data["status"] == {"done": 12} and data["with_playback"]
    assert all(cell["statuses"] == {"done": 2} for cell in data["cells"])
    episodes = pd.read_parquet(runs["rover"] / "episodes.parquet")
    curves = pd.read_parquet(runs["rover"] / "curves.parquet")
    for cell in data["cells"]:
        name = data["agents"][cell["agent"]]["name"]
        environment = data["environments"][cell["environment"]]["disturbance"]
        key = {"algorithm": name, "disturbance": environment, "history_length": cell["length"]}
        loss = cell["learning"]["critic_loss"]
        assert loss["steps"] == [40, 60] and loss["iqm"] == [2.5, 1.0]  # means over two seeds
        final = rows_of(episodes, key).groupby("seed")["return"].mean()
        assert cell["final"]["return"]["mean"] == pytest.approx(final.mean(), rel=1e-4)
        points = rows_of(curves, key).groupby("step")["return"].mean()
        assert cell["curves"]["return"]["steps"] == STEPS
        assert cell["curves"]["return"]["iqm"] == pytest.approx(points.tolist(), rel=1e-4)
    assert data["environments"][0]["ceiling"]["kind"] == "upper bound"
    on = GRIDS["rover"].disturbances
    matrix = {(t["trained_on"], t["tested_on"]) for t in data["transfer"]}
    assert matrix == {(on[0], on[1]), (on[1], on[1])}


def test_playback_is_what_the_policy_does(runs):
    directory = RunDirectory.open(runs["pendulum"])
    cell = directory.cells[-1]
    policy, env = directory.lanes.policy(cell, 0), cell.make_env()
    frames = record_episodes(policy, env, 2, 5, 200)
    assert frames["done"][:, -1].all() and not frames["done"][:, :-1].any()
    totals = frames["reward"][..., 0].sum(axis=1)
    np.testing.assert_allclose(totals, rtd.evaluate(policy, env, 2, 5), rtol=1e-5)
    assert not np.allclose(frames["seen"], frames["true"])


def test_the_page_needs_no_network_and_is_small(runs):
    for run in runs.values():
        page = (run / "report.html").read_text()
        assert len(page) < 2_000_000
        assert not re.search(r'(src|href)="(?!#|data:)', page) and "import(" not in page


@pytest.mark.parametrize("env", sorted(GRIDS))
def test_in_a_browser(env, runs):
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1200, "height": 900})
        troubles, requests = [], []
        page.on("console", lambda message: troubles.append(message.text))
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        page.goto((runs[env] / "report.html").as_uri())
        lines = page.locator("#curves .agent-line")
        before = lines.count()
        assert before == 4 * len(
            GRIDS[env].disturbances
        )  # two agents in two panels of each environment

        # A filter changes the curves; the keyboard does it too.
        page.locator("#filters label", has_text="td3").first.click()
        assert lines.count() == before // 2
        page.locator("#filters input[value='0'][name='agent']").press("Space")
        assert lines.count() == before

        # What was measured while they learned is folded, and drawn once it is asked for.
        assert page.locator("#learning .agent-line").count() == 0
        page.locator("#learning summary").click()
        # The event that draws them comes after the click.
        page.locator("#learning .agent-line").nth(before - 1).wait_for(state="attached")
        assert page.locator("#learning .agent-line").count() == before
        assert "critic loss" in page.locator("#learning figcaption").first.inner_text()
        if pictures := os.environ.get("RTD3JAX_PAGE_PICTURES"):
            page.screenshot(path=f"{pictures}/{env}-learning.png", full_page=True)

        # Arrow keys read a curve.
        plot = page.locator("#curves svg.plot").first
        plot.focus()
        plot.press("ArrowLeft")
        assert "step 40" in page.locator("#tip").inner_text()

        # A heading sorts.
        head = page.locator("#table th button", has_text="mean")
        head.click()
        column = page.locator("#table tbody tr td:nth-child(7)").all_inner_texts()
        values = [float(t.replace("−", "-").replace(",", "")) for t in column]
        assert values == sorted(values, reverse=True)
        assert page.locator("th[aria-sort='descending']").count() == 1

        # Playback moves, and can be dragged.
        moving = {"pendulum": ".scene line.truth", "rover": ".scene g"}[env]
        picture = page.locator(moving).first
        still = picture.evaluate("node => node.outerHTML")
        page.locator("#play").click()
        for _ in range(100):
            if "step 1 of" not in page.locator("#clock").inner_text():
                break
            page.wait_for_timeout(50)
        assert picture.evaluate("node => node.outerHTML") != still
        page.locator("#play").click()
        page.locator("#scrub").fill("150")
        assert page.locator("#clock").inner_text() == "step 151 of 200"

        # Keys play it, on the button, the slider and the episodes; each control keeps its own keys.
        clock, play = page.locator("#clock"), page.locator("#play")
        page.locator("#scrub").fill("10")
        page.locator("#scrub").press("ArrowRight")
        assert clock.inner_text() == "step 12 of 200"
        play.press("ArrowRight")
        assert clock.inner_text() == "step 13 of 200"
        page.locator(".stages").press("ArrowLeft")
        assert clock.inner_text() == "step 12 of 200"
        page.locator("#scrub").press("Space")
        assert play.inner_text() == "Pause"
        play.press("Space")
        assert play.inner_text() == "Play"
        page.locator(".stages").press("Space")
        assert play.inner_text() == "Pause"
        page.locator("#playback select[name='speed']").press("Space")
        assert play.inner_text() == "Pause"
        page.keyboard.press("Escape")  # closes the list of speeds
        page.locator(".stages").press("Space")
        assert play.inner_text() == "Play"

        # On a phone nothing is wider than the screen; in the dark the paper is dark.
        page.set_viewport_size({"width": 375, "height": 700})
        page.emulate_media(color_scheme="dark")
        page.wait_for_timeout(300)
        assert page.evaluate("document.documentElement.scrollWidth") <= 375
        colour = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert max(map(int, re.findall(r"\d+", colour)[:3])) < 60
        if pictures := os.environ.get("RTD3JAX_PAGE_PICTURES"):
            page.screenshot(path=f"{pictures}/{env}-phone.png", full_page=True)
        assert troubles == [] and len(requests) == 1


def test_a_tap_shows_values_until_the_next(runs):
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 375, "height": 700}, has_touch=True)
        page.goto((runs["rover"] / "report.html").as_uri())
        tip = page.locator("#tip")
        for k, length in enumerate((1, 2)):
            page.locator("#curves svg.plot").nth(k).tap(position={"x": 320, "y": 100})
            assert f"history {length}: step 60" in tip.inner_text()
        page.locator("#finals svg rect").first.tap()
        assert "2 seeds" in tip.inner_text()
        box = tip.bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 375
        page.locator("#finals h2").tap()
        assert tip.is_hidden()


def test_an_unfinished_run_has_a_page_that_says_so(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(ceilings, "ceiling", lambda env, **_: Ceiling(-1.2, 0.1, "exact"))
    study = json.loads((runs["rover"] / "config.json").read_text())
    hostile = tmp_path / "<script>alert(1)<"
    hostile.mkdir()
    (hostile / "config.json").write_text(json.dumps(study))
    assert report.main([str(hostile)]) == 0
    page = (hostile / "report.html").read_text()
    assert "<script>alert" not in page
    data = data_of(hostile)
    assert data["status"] == {"planned": 12}
    assert data["notes"][0] == "no lane has ended yet"
    assert data["transfer"] is None and data["playback"] == []
    assert all(cell["statuses"] == {"planned": 2} for cell in data["cells"])
    directory = RunDirectory.open(hostile)
    cell = directory.cells[0]
    directory.lanes.write_error(cell, 0, "the plant is on fire")
    (hostile / "cluster.jsonl").touch()
    row = {**cell.key, "seed": 1, "step": 20, "return": -1.0, "seconds": 3.0}
    earlier = {**row, "step": 60, "return": 5.0}  # before the lane was trained again
    removed = {**directory.cells[1].key, "seed": 0, "step": 60, "return": 7.0, "seconds": 4.0}
    rows = earlier, row, removed  # of the last one, the log reaches the end, but there is no file
    (hostile / "log.jsonl").write_text("".join(json.dumps(one) + "\n" for one in rows))
    data = page_data(directory, complete=True, playback=False)
    assert data["cells"][0]["statuses"]["failed"] == 1 and not data["with_playback"]
    assert data["timing"] == {"steps": 80, "shards": 0}  # each task has a clock of its own
    assert data["cells"][0]["curves"]["return"]["steps"] == [20]
    assert data["cells"][1]["curves"]["return"] is data["cells"][2]["curves"]["return"] is None


def test_a_lane_that_was_copied_from_its_run_is_named(runs, tmp_path):
    directory = RunDirectory.open(runs["rover"])
    own = directory.lanes.lane_path(directory.cells[0], 0)
    with pytest.raises(
        rtd.UserError, match=rf"load_policy\('{re.escape(str(runs['rover']))}', algorithm"
    ):
        rtd.load_policy(own)
    shutil.copy(own, tmp_path / "alone.safetensors")
    with pytest.raises(rtd.UserError, match=r"load_policy\(its run directory, algorithm"):
        rtd.load_policy(tmp_path / "alone.safetensors")


def test_an_agent_without_a_mean_has_none_in_the_printed_table(runs, monkeypatch, capsys):
    rows = pd.DataFrame({"env": "rover", "algorithm": ["td3", "td3", "h-td3"], "history_length": 0})
    rows = rows.assign(trained_on="none", tested_on="a", **{"return": [1.0, np.nan, -2.5]})
    monkeypatch.setattr("rtd3jax.cli.transfer.transfer", lambda *_: rows)
    monkeypatch.setattr("rtd3jax.cli.transfer.refresh_page", lambda *_, **__: None)
    assert transfer.main([str(runs["rover"])]) == 0
    td3, h_td3 = re.findall(r"td3 +0 +none +(\S+)", capsys.readouterr().out)
    assert (td3, h_td3) == ("NaN", "-2.5")


def test_returns_of_policies_that_were_trained_further_are_left_out(runs, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(runs["rover"], run)
    assert stress.main([str(run), "--episodes", "1", "--stresses", "noise=0"]) == 0
    directory = RunDirectory.open(run)
    before = page_data(directory, complete=False, playback=False)
    assert before["notes"] == [] and before["robustness"]
    changed = 0
    for cell in directory.cells[:2]:
        for seed in directory.seeds:
            path = directory.lanes.lane_path(cell, seed)
            arrays, metadata = read_arrays(path)
            write_arrays(path, arrays, {**metadata, "again": True})
            changed += 1
    after = page_data(directory, complete=False, playback=False)
    for name in ("transfer", "robustness"):
        assert len(after[name]) == len(before[name]) - 2
        (gone,) = [note for note in after["notes"] if note.startswith(f"{name}.parquet has")]
        assert f"returns of {changed} policies that the study has no longer" in gone
        assert any(note.startswith(f"{name}.parquet lacks {changed} of") for note in after["notes"])

    # A table of an earlier version does not tell its policies.
    table = pd.read_parquet(run / "transfer.parquet").drop(columns="lane")
    table.to_parquet(run / "transfer.parquet")
    old = page_data(directory, complete=False, playback=False)
    assert old["transfer"] == before["transfer"]

    # A seed with a return that is not a number is counted as lost.
    table.loc[table.index[0], "return"] = np.nan
    table.to_parquet(run / "transfer.parquet")
    first = page_data(directory, complete=False, playback=False)["transfer"][0]
    assert (first["lost"], first["n"]) == (1, len(directory.seeds) - 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["nowhere"], "there is no study"), (["RUN", "--out", "thesis.html"], "is not a page")],
)
def test_bad_input_is_one_line(arguments, message, runs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "thesis.html").write_text("mine")
    arguments = [str(runs["rover"]) if a == "RUN" else a for a in arguments]
    assert report.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1
    assert (tmp_path / "thesis.html").read_text() == "mine"


def test_transfer_names_what_does_not_fit(runs, capsys):
    run = str(runs["pendulum"])
    assert transfer.main([run, "--on", "hidden", "--episodes", "1"]) == 2
    captured = capsys.readouterr()
    assert "3 observation elements" in captured.out and "no policy in" in captured.err
    assert transfer.main([run, "--episodes", "0"]) == 2
    assert "episodes must be an integer of at least 1" in capsys.readouterr().err
    assert transfer.main([run, "--on", "nose"]) == 2
    assert "did you mean 'noise'" in capsys.readouterr().err
