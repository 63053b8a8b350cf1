"""Tests that tables hold all lanes that have ended, also after a sweep was killed."""

import dataclasses
import hashlib
import io
import os
import shutil
import sys

import numpy as np
import pandas as pd
import pytest
from made_run import STEPS, make_run

import rtd3jax as rtd
from rtd3jax import compare, stress
from rtd3jax.study.cells import Grid
from rtd3jax.study.comparison import compare_runs
from rtd3jax.study.derive import derive
from rtd3jax.study.loggers import _lane_id
from rtd3jax.study.report.page import page_data, write_page
from rtd3jax.study.results import key_columns
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.tables import SCHEMAS, current_tables
from rtd3jax.system.files import read_arrays, write_arrays


@pytest.fixture
def whole(tmp_path):
    """A run whose tables hold all of its lanes: two cells of two seeds."""
    return make_run(tmp_path / "whole", Grid("rover", ("ar1-slip",), ("td3", "h-td3"), (2,)))


def killed_after(whole, count, path):
    """The run as it was left if the sweep was killed after its tables had ``count`` lanes."""
    shutil.copytree(whole.path, path)
    directory = RunDirectory.open(path)
    files = sorted(path.glob("lanes/*/*.safetensors"))
    later = {file: file.read_bytes() for file in files[count:]}
    for file in later:
        file.unlink()
    for name in SCHEMAS:
        (path / f"{name}.parquet").unlink()
    if count:
        derive(directory, [], pictures=False)
    for file, content in later.items():
        file.write_bytes(content)
    return directory


def same(tables, expected):
    """Whether the rows of trained lanes are the same in any order."""
    for name, schema in SCHEMAS.items():
        keys = key_columns(schema)
        one, other = (
            table[name].loc[table[name]["seed"] >= 0].sort_values(keys).reset_index(drop=True)
            for table in (tables, expected)
        )
        pd.testing.assert_frame_equal(one, other)
    return True


@pytest.mark.parametrize("count", [0, 1, 3])
def test_lanes_that_ended_after_the_tables_were_written_are_there(count, whole, tmp_path):
    expected = current_tables(whole)
    assert expected["episodes"]["seed"].nunique() == 3  # two seeds, and the reference's
    killed = killed_after(whole, count, tmp_path / "killed")
    assert same(current_tables(killed), expected)
    study = rtd.Study(killed.cells, seeds=killed.seeds, out=killed.path, final_episodes=2)
    assert same(study.tables(), expected)
    data = page_data(killed, complete=False, playback=False)
    assert data["notes"] == [] and [cell["final"]["return"]["n"] for cell in data["cells"]] == [
        2,
        2,
    ]
    compared = compare_runs([whole, killed], ["whole", "killed"])
    assert compared["n"].tolist() == [2] * 4 and compared["pairs"].tolist() == [0, 2] * 2


@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize("count", [0, 3])
@pytest.mark.parametrize("names", [["curves"], ["curves", "episodes"]])
def test_a_sweep_that_was_killed_between_two_tables_has_no_half_lanes(
    names, count, older, whole, tmp_path
):
    killed = killed_after(whole, count, tmp_path / "killed")
    if older:  # the lane ended while the first tables were being written
        for file in killed.path.glob("lanes/*/*.safetensors"):
            os.utime(file, (1, 1))
    for name in names:  # they were written with all lanes; the others were not yet
        shutil.copy(whole.path / f"{name}.parquet", killed.path)
    assert same(current_tables(killed), current_tables(whole))


def extend(run, steps):
    """The run whose first cell is to be trained to ``steps``, from checkpoints."""
    cell, *others = run.cells
    for seed in run.seeds:
        kept = run.lanes.checkpoint_directory(cell, seed)
        kept.mkdir(parents=True)
        (kept / f"step-{STEPS[-1]:09d}.safetensors").touch()
    longer = dataclasses.replace(cell, config=dataclasses.replace(cell.config, total_steps=steps))
    return RunDirectory.create(run.path, [longer, *others], run.seeds, run.episodes)


def test_results_of_fewer_steps_are_not_those_of_a_study_with_more(whole, tmp_path):
    shutil.copytree(whole.path, tmp_path / "before")
    before, run = RunDirectory.open(tmp_path / "before"), extend(whole, 80)
    (cell, other), steps = run.cells, [*STEPS, 80]
    tables = current_tables(run)
    trained = tables["episodes"][tables["episodes"]["seed"] >= 0]
    assert set(trained["algorithm"]) == {"h-td3"} and len(trained) == 4
    assert set(tables["curves"]["algorithm"]) == {"h-td3"}
    data = page_data(run, complete=False, playback=False)
    assert [cell["final"]["return"] is None for cell in data["cells"]] == [True, False]
    assert data["notes"] == []
    assert set(compare_runs([before, run], ["before", "run"])["algorithm"]) == {"h-td3"}

    curves = {"steps": np.array(steps), "returns": np.zeros(4), "true_returns": np.zeros(4)}
    curves |= {"final_returns": np.zeros(2), "final_true_returns": np.zeros(2)}
    run.lanes.write_lane(cell, 0, {}, curves, {}, None)
    found = current_tables(run)["curves"]
    assert found[found["algorithm"] == "td3"]["step"].tolist() == steps
    assert len(found[found["algorithm"] == other.config.algorithm]) == 2 * len(STEPS)


def test_a_lane_that_was_trained_again_replaces_its_rows(whole):
    before = current_tables(whole)
    path = whole.lanes.lane_path(whole.cells[0], 1)
    arrays, metadata = read_arrays(path)
    arrays["results.final_returns"] = arrays["results.final_returns"] + 1.0
    write_arrays(path, arrays, metadata)
    after = current_tables(whole)
    assert len(after["episodes"]) == len(before["episodes"])
    changed = after["episodes"]["return"].sum() - before["episodes"]["return"].sum()
    assert changed == pytest.approx(2.0, abs=1e-5)  # two episodes


@pytest.mark.parametrize("whole_cell", [False, True])
def test_a_lane_whose_file_was_removed_to_train_it_again_has_no_rows(whole_cell, whole):
    before = current_tables(whole)
    cell = whole.cells[0]
    path = whole.lanes.lane_path(cell, 1)
    shutil.rmtree(path.parent) if whole_cell else path.unlink()
    study = rtd.Study(whole.cells, seeds=whole.seeds, out=whole.path, final_episodes=2)
    status = study.status()
    assert (status["status"] == "planned").sum() == 1 + whole_cell
    for name, table in study.tables().items():
        trained = table[table["seed"] >= 0]
        own = trained.loc[trained["algorithm"] == cell.config.algorithm, "seed"]
        assert set(own) == (set() if whole_cell else {0})
        references = len(before[name]) - (before[name]["seed"] >= 0).sum()
        assert len(table) - len(trained) == references
    page_data(whole, complete=False, playback=False)


def test_tables_without_the_files_of_lanes_stay(whole, tmp_path):
    """A copy may have the tables only."""
    copy = tmp_path / "copy"
    shutil.copytree(whole.path, copy, ignore=shutil.ignore_patterns("lanes"))
    assert same(current_tables(RunDirectory.open(copy)), current_tables(whole))


def test_a_damaged_lane_or_table_is_named(whole):
    expected = current_tables(whole)
    damaged = whole.lanes.lane_path(whole.cells[1], 0)
    content = damaged.read_bytes()
    damaged.write_bytes(content[:-1])
    with pytest.raises(rtd.UserError, match=f"remove .*{damaged.name} and repeat the command"):
        current_tables(whole)
    notes = []
    assert len(current_tables(whole, notes)["curves"]) == len(expected["curves"]) * 3 // 4
    assert len(notes) == 1 and damaged.name in notes[0]

    damaged.write_bytes(content)
    (whole.path / "episodes.parquet").write_bytes(b"nothing")
    os.utime(whole.path / "curves.parquet")
    with pytest.raises(rtd.UserError, match="cannot be read as a Parquet file"):
        current_tables(whole)
    notes = []
    assert len(current_tables(whole, notes)["curves"]) == len(expected["curves"])
    assert len(notes) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes only on Linux")
def test_the_name_of_a_run_may_be_bytes_that_are_not_text(tmp_path):
    run = make_run(
        tmp_path / os.fsdecode(b"run-\xff"), Grid("rover", ("ar1-slip",), ("td3",), (1,))
    )
    assert len(current_tables(run)["curves"]) == 6
    page = write_page(run, playback=False, complete=False)
    assert "<title>run-?" in page.read_text("utf-8")
    assert stress.main([str(run.path), "--episodes", "1", "--stresses", "noise=0"]) == 0
    assert page_data(run, complete=False, playback=False)["robustness"]
    other = make_run(
        tmp_path / os.fsdecode(b"run-\xfe"), Grid("rover", ("ar1-slip",), ("td3",), (1,))
    )
    out = tmp_path / os.fsdecode(b"compared-\xff")
    assert compare.main([str(run.path), str(other.path), "--out", str(out)]) == 0
    table = pd.read_parquet(io.BytesIO((out / "compare.parquet").read_bytes()))
    names = table["run"].tolist()
    assert names == [r"run-\udcff", r"run-\udcfe"]
    assert r"run-\udcfe" in (out / "compare.md").read_text("utf-8")


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes only on Linux")
def test_messages_and_ids_of_paths_that_are_not_text(whole, tmp_path):
    path, cell = str(tmp_path / os.fsdecode(b"start-\xff")), whole.cells[0]
    whole.lanes.write_error(cell, 0, f"{path} cannot be read")
    assert whole.lanes.error(cell, 0).endswith("start-? cannot be read")
    whole.lanes.write_start(cell, 0, f"policy {path}")
    derive(whole, [], pictures=False)
    assert "start-?" in (whole.path / "summary.md").read_text("utf-8")
    ids = {_lane_id(name, "cell", 0) for name in (path, path[:-1], f"{path}2")}
    assert len(ids) == 3
    # The ids of other paths are those of earlier versions: their trackers continue.
    assert _lane_id("runs/a", "cell", 0) == hashlib.sha256(b"runs/a\ncell\n0").hexdigest()[:24]
