"""Tests that `Study` writes the same files as the sweep."""

import dataclasses
import os
import signal

import pandas as pd
import pytest
from made_run import make_run

import rtd3jax as rtd
from rtd3jax import sweep
from rtd3jax.cli import sweep as sweep_module
from rtd3jax.study import execute, process_plan, recorder, run
from rtd3jax.study import processes as processes_module
from rtd3jax.study.cells import Grid
from rtd3jax.study.lane_files import check_names
from rtd3jax.study.lock import is_held
from rtd3jax.training import lanes

TINY = dict(
    total_steps=60,
    hidden_size=4,
    batch_size=4,
    learning_starts=10,
    eval_every=30,
    eval_episodes=1,
)


def _cells(**changes):
    return [
        rtd.Cell("rover", "ar1-slip", rtd.Config(algorithm=name, history_length=length, **settings))
        for name, length in (("td3", None), ("h-td3", 2))
        for settings in [TINY | changes]
    ]


def test_a_study_is_the_sweeps_file_for_file(tmp_path):
    study = rtd.Study(_cells(), seeds=[0, 1], out=tmp_path / "study", final_episodes=2)
    assert set(study.status()["status"]) == {"planned"}
    assert study.run(quiet=True, page=False) == []
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in TINY.items()]
    command = "--env rover --disturbances ar1-slip --algorithms td3 h-td3 --history-lengths 2"
    command += " --seeds 2 --final-episodes 2 --quiet --no-report"
    assert sweep.main([*command.split(), *flags, "--out", str(tmp_path / "sweep")]) == 0
    for name in ("curves.parquet", "episodes.parquet", "metrics.parquet", "summary.md"):
        one, other = (tmp_path / run / name for run in ("study", "sweep"))
        assert one.read_bytes() == other.read_bytes(), name
    lanes = sorted(p.relative_to(tmp_path / "sweep") for p in tmp_path.glob("sweep/lanes/*/*"))
    assert len(lanes) == 4
    for lane in lanes:
        one, other = (tmp_path / run / lane for run in ("study", "sweep"))
        assert one.read_bytes() == other.read_bytes()

    again = rtd.Study(_cells(), seeds=[0, 1], out=tmp_path / "study", final_episodes=2)
    assert set(again.status()["status"]) == {"done"}
    tables = again.tables()
    assert set(tables) == {"curves", "episodes", "metrics"}
    assert isinstance(tables["metrics"], pd.DataFrame) and len(tables["curves"]) == 8
    assert all(path.exists() for path in again.figures())
    assert again.policy(_cells()[1], 1).algorithm == "h-td3"
    with pytest.raises(rtd.UserError, match="holds another study"):
        rtd.Study(_cells(gamma=0.5), seeds=[0, 1], out=tmp_path / "study", final_episodes=2)


def test_cells_that_tables_could_not_tell_apart_are_refused(tmp_path):
    both = [*_cells(), *_cells(gamma=0.5)]
    with pytest.raises(rtd.UserError, match="two cells are both rover, ar1-slip, td3, 0"):
        rtd.Study(both, out=tmp_path / "study")
    with pytest.raises(rtd.UserError, match="at least one cell"):
        rtd.Study([], out=tmp_path / "study")
    with pytest.raises(rtd.UserError, match="consists of rtd.Cell, not str"):
        rtd.Study(["rover"], out=tmp_path / "study")
    assert not (tmp_path / "study").exists()


@pytest.mark.parametrize(
    ("cell", "options", "message"),
    [
        (("rovr", "ar1-slip"), {}, "unknown environment 'rovr'"),
        (("rover", "ar2-slip"), {}, "unknown disturbance 'ar2-slip'"),
        (("rover", "ar1-slip", rtd.Config("td3", start="nowhere")), {}, "nowhere cannot be read"),
        (("rover", "ar1-slip"), {"final_episodes": 2.5}, "final_episodes must be an integer"),
        (("rover", "ar1-slip"), {"final_episodes": 0}, "final_episodes must be an integer"),
        (("rover", "ar1-slip"), {"final_episodes": "20"}, "final_episodes must be an integer"),
    ],
)
def test_a_study_that_cannot_run_writes_nothing(cell, options, message, tmp_path):
    env, disturbance, *config = cell
    cells = [rtd.Cell(env, disturbance, *config or [rtd.Config("td3")])]
    with pytest.raises(rtd.UserError, match=message):
        rtd.Study(cells, out=tmp_path / "study", **options)
    assert not list(tmp_path.iterdir())


def test_a_cell_that_cannot_run_is_not_added(tmp_path):
    rtd.Study(_cells(), seeds=[0], out=tmp_path / "study")
    before = (tmp_path / "study" / "config.json").read_bytes()
    wrong = rtd.Cell("rovr", "none", rtd.Config("td3"))
    with pytest.raises(rtd.UserError, match="unknown environment 'rovr'"):
        rtd.Study([*_cells(), wrong], seeds=[0], out=tmp_path / "study").run(quiet=True)
    assert (tmp_path / "study" / "config.json").read_bytes() == before


def test_cells_whose_files_would_have_one_name_are_refused(tmp_path):
    joined, foreign = (("a_b", "c"), ("a", "b_c")), (("rover", "風"), ("rover", "砂"))
    cases = ("rover", "Slip"), ("rover", "slip")  # one directory on macOS and Windows
    for pair in (joined, foreign, cases):
        with pytest.raises(rtd.UserError, match="would have the same name"):
            rtd.Study([rtd.Cell(*two, rtd.Config("td3")) for two in pair], out=tmp_path / "study")
    assert not list(tmp_path.iterdir())


def test_a_cell_whose_directory_name_is_too_long_is_refused_before_anything_changes(
    tmp_path, capsys
):
    long = rtd.Cell("rover", "/".join(["ar1-slip"] * 30), rtd.Config("td3"))
    match = "directory name of rover ar1-slip/.* td3 would have 282 letters.*short name .rtd.reg"
    with pytest.raises(rtd.UserError, match=match):
        rtd.Study([long], out=tmp_path / "study")
    assert not list(tmp_path.iterdir())
    rtd.Study(_cells(), seeds=[0], out=tmp_path / "study")
    command = ["--env", "rover", "--disturbances", long.disturbance, "--algorithms", "td3"]
    assert sweep.main([*command, "--out", str(tmp_path / "study"), "--fresh"]) == 2
    assert "would have 282 letters" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["study"]


def test_names_that_an_existing_study_has_do_not_stop_its_growth():
    cells = [rtd.Cell("rover", name, rtd.Config("td3")) for name in ("Slip", "slip", "SLIP")]
    check_names(cells[:2], there=2)
    with pytest.raises(rtd.UserError, match="same name but for upper and lower case"):
        check_names(cells, there=2)


@pytest.mark.parametrize("processes", [1, 2])
@pytest.mark.parametrize("name", ["lanes", "checkpoints"])
def test_files_that_cannot_be_written_are_noticed_before_the_training(
    name, processes, tmp_path, monkeypatch, capsys
):
    def refuse(*_, **__):
        raise AssertionError("training began")

    monkeypatch.setattr(execute, "advance_groups", refuse)
    monkeypatch.setattr(processes_module, "Crew", refuse)
    monkeypatch.setattr(process_plan, "cores", lambda: 2)
    rtd.Study(_cells()[:1], seeds=[0, 1], out=tmp_path, final_episodes=2)
    (tmp_path / name).write_text("")  # root may write to any directory, but not into a file
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in TINY.items()]
    command = "--env rover --disturbances ar1-slip --algorithms td3 --history-lengths 2 --seeds 2"
    command += f" --final-episodes 2 --no-report --processes {processes} --out {tmp_path}"
    assert sweep.main([*command.split(), *flags]) == 2
    error = capsys.readouterr().err
    assert f"{tmp_path / name}" in error and "cannot be written" in error
    assert error.count("\n") == 1


def test_a_policy_of_a_cell_with_other_settings_is_refused(tmp_path):
    run_of_td3 = make_run(tmp_path / "run", Grid("rover", ("ar1-slip",), ("td3",), (1,)))
    (cell,) = run_of_td3.cells
    study = rtd.Study([cell], seeds=[0, 1], out=run_of_td3.path, final_episodes=2)
    assert study.policy(cell, 1).algorithm == "td3"
    for field, value in (("gamma", 0.5), ("replay_capacity", 50)):
        config = dataclasses.replace(cell.config, **{field: value})
        with pytest.raises(rtd.UserError, match=f"rover ar1-slip td3 with another {field} "):
            study.policy(dataclasses.replace(cell, config=config), 1)
    with pytest.raises(rtd.UserError, match="no cell rover none td3, only rover ar1-slip td3"):
        study.policy(dataclasses.replace(cell, disturbance="none"), 1)
    longer = dataclasses.replace(cell.config, total_steps=90)
    with pytest.raises(rtd.UserError, match="seed 1 is not trained yet"):
        study.policy(dataclasses.replace(cell, config=longer), 1)
    with pytest.raises(rtd.UserError, match="consists of rtd.Cell, not str"):
        study.policy("td3", 1)
    with pytest.raises(rtd.UserError, match=r"run has no seed 9; its seeds are \[0, 1\]"):
        study.policy(cell, 9)


@pytest.mark.parametrize("how", ["study", "sweep"])
def test_after_an_interrupt_the_page_does_not_say_that_lanes_are_running(
    how, tmp_path, monkeypatch
):
    """The page reads from the lock whether a process trains lanes."""
    held = []

    def interrupt(*_, **__):
        held.append(is_held(tmp_path / "run"))
        raise KeyboardInterrupt

    def finish(directory, *_, interrupted, **__):
        assert interrupted
        held.append(is_held(directory.path))
        (directory.path / "summary.md").write_text("")

    monkeypatch.setattr(run if how == "study" else sweep_module, "train_here", interrupt)
    monkeypatch.setattr(run, "finish", finish)
    if how == "study":
        with pytest.raises(KeyboardInterrupt):
            rtd.Study(_cells(), seeds=[0], out=tmp_path / "run").run(quiet=True)
    else:
        command = "--env rover --disturbances ar1-slip --algorithms td3 --history-lengths 1 --seeds"
        assert sweep.main([*command.split(), "1", "--out", str(tmp_path / "run")]) == 130
    assert held == [True, False]


def test_sigterm_leaves_checkpoints_of_a_study_too(tmp_path, monkeypatch):
    real = recorder.Recorder.update

    def update(self, group):
        real(self, group)
        if group.step >= 20:
            os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(lanes, "_FIRST_CHUNK", 10)
        patch.setattr(lanes, "CHUNK_SECONDS", 0.0)
        patch.setattr(recorder.Recorder, "update", update)
        study = rtd.Study(_cells(), seeds=[0], out=tmp_path / "run")
        with pytest.raises(KeyboardInterrupt):
            study.run(quiet=True, page=False)
    assert list((tmp_path / "run").rglob("step-*.safetensors"))
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    assert study.run(quiet=True, page=False) == []
