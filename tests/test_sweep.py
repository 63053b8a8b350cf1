"""Tests of the sweep's command: its files, its errors, and its continuation."""

import errno
import json
import math
from types import SimpleNamespace

import jax
import numpy as np
import pandas as pd
import pytest

from rtd3jax import compare, report, sweep
from rtd3jax.agents.variants import ALGORITHMS
from rtd3jax.cli import sweep_options
from rtd3jax.config import Config
from rtd3jax.envs import registry
from rtd3jax.errors import UserError
from rtd3jax.study import finish, interim, presets, recorder, references, time_estimate
from rtd3jax.study.cells import Cell, Grid, bar_labels, make_cells
from rtd3jax.study.log import read_log
from rtd3jax.study.presets import PRESETS
from rtd3jax.study.results import CURVES, EPISODES, read_table
from rtd3jax.training import lanes
from rtd3jax.training.checkpoint import Checkpoints

TINY = [
    *("--env", "rover", "--disturbances", "ar1-slip", "--algorithms", "td3", "lstm-td3-1ha1hc"),
    *("--history-lengths", "2", "--seeds", "2", "--total-steps", "60", "--hidden-size", "4"),
    *("--batch-size", "4", "--learning-starts", "10", "--eval-every", "30"),
    *("--eval-episodes", "1", "--final-episodes", "2", "--quiet"),
]


@pytest.fixture(autouse=True)
def no_page(monkeypatch):
    monkeypatch.setattr(finish, "refresh_page", lambda *_, **__: None)


def _files(directory, *names):
    return [(directory / name).read_bytes() for name in names]


def test_a_run_directory_holds_what_it_should(tmp_path, capsys, monkeypatch, pictures):
    out = tmp_path / "run"
    pages = []
    monkeypatch.setattr(finish, "refresh_page", lambda run, complete: pages.append(complete))
    assert sweep.main([*TINY, "--out", str(out)]) == 0
    assert pages == [True]
    curves = read_table(out / "curves.parquet", CURVES)
    assert len(curves) == 2 * 2 * 2 and set(curves["step"]) == {30, 60}
    episodes = read_table(out / "episodes.parquet", EPISODES)
    trained, baselines = {"td3", "lstm-td3-1ha1hc"}, {"random", "constant", "feedforward-pi"}
    assert set(episodes["algorithm"]) == trained | baselines
    assert np.isfinite(episodes["return"]).all()
    study = json.loads((out / "config.json").read_text())
    assert study["made_with"]["versions"]["jax"] == jax.__version__
    assert study["study"]["cells"][1]["history_length"] == 2
    for name in ("learning_curves", "final_returns"):
        assert (out / f"{name}.png").stat().st_size > 5_000 and (out / f"{name}.svg").exists()
    assert "lstm-td3-1ha1hc" in capsys.readouterr().out
    assert len(list(out.rglob("*.safetensors"))) == 4
    assert len((out / "log.jsonl").read_text().splitlines()) == 8

    # The same command again trains what is missing, and gives the same bits.
    tables = "curves.parquet", "episodes.parquet", "summary.md"
    before = _files(out, *tables)
    lane = next(out.glob("lanes/*lstm*/seed-1.safetensors"))
    kept = lane.read_bytes()
    lane.unlink()
    for cell in study["study"]["cells"]:  # as written before there was such a field
        del cell["actor_noise"]
    (out / "config.json").write_text(json.dumps(study))
    assert sweep.main([*TINY, "--out", str(out)]) == 0
    assert "3 of 4 lanes have ended already" in capsys.readouterr().out
    assert lane.read_bytes() == kept and _files(out, *tables) == before

    # Another study does not go there; a broken lane is named.
    assert sweep.main([*TINY, "--out", str(out), "--gamma", "0.9"]) == 2
    assert "holds another study (gamma: 0.99 there, 0.9 here)" in capsys.readouterr().err
    lane.write_bytes(kept[:100])
    assert sweep.main([*TINY, "--out", str(out)]) == 2
    assert "seed-1.safetensors cannot be read" in capsys.readouterr().err


def test_an_interrupt_leaves_a_readable_directory(tmp_path, monkeypatch):
    real = recorder.Recorder.update
    calls = []

    def interrupted(self, group):
        real(self, group)
        calls.append(group)
        if group.finished:
            raise KeyboardInterrupt

    monkeypatch.setattr(recorder.Recorder, "update", interrupted)
    out = tmp_path / "run"
    assert sweep.main([*TINY, "--out", str(out)]) == 130
    assert len(read_table(out / "curves.parquet", CURVES)) == 2
    monkeypatch.setattr(recorder.Recorder, "update", real)
    assert sweep.main([*TINY, "--out", str(out)]) == 0
    assert len(read_table(out / "curves.parquet", CURVES)) == 8


def test_a_lost_lane_is_reported_and_the_exit_status_says_so(tmp_path, capsys):
    arguments = [*TINY, "--out", str(tmp_path / "run"), "--critic-learning-rate", "1e30"]
    assert sweep.main(arguments) == 1
    captured = capsys.readouterr()
    assert "lost at step" in captured.err and "lower actor_learning_rate" in captured.out
    assert sweep.main(arguments) == 1  # also if nothing is trained again
    assert "lanes were lost or failed before: --status says why" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "choose what to run"),
        ("--env rovr", "did you mean 'rover'"),
        ("--env rover --disturbances ar1-slipp", "did you mean 'ar1-slip'"),
        ("--env rover --algorithms h-td", "did you mean 'h-td3'"),
        ("--env CartPole-v1", "has discrete actions"),
        ("--preset quick --seeds 0", "seeds must be from 1"),
        ("--preset quick --total-steps -1", "total_steps must be at least 1"),
        ("--preset quick --batch-size 5000", "is larger than learning_starts"),
        ("--env pendulum --disturbances noise:sigma=-1", "sigma=-1.0 must be at least 0"),
        ("--preset quick --device gpu", "--device gpu: this machine has none"),
        ("--preset quick --hidden-size 200000", "one lane needs"),
        ("--preset quick --history-lengths 0", "history_length must be at least 1"),
        ("--preset rover --env pendulum", "has settings for rover"),
        ("--preset quick --dry-run --hidden-size 200000", "one lane needs"),
        ("--preset quick --dry-run --start nowhere", "nowhere cannot be read"),
        ("--preset quick --dry-run --shard 9/4", "not of the form i/n"),
        ("--preset quick --dry-run --checkpoint-every banana", "'banana' is not like 300s"),
        ("--preset quick --import ./tank.py", "give a module's name: --import tank"),
        ("--preset quick --import=", "--import '': Empty module name"),
        ("--preset quick --cluster=", "--cluster is empty: name an address"),
        ("--preset quick --start=", "--start is empty: name a run"),
        ("--preset quick --seed 3", "unrecognized arguments: --seed 3"),
        ("--preset quick --fresh --shard 1/2", "rename it once, then start them without --fresh"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys, tmp_path):
    assert sweep.main([*arguments.split(), "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("error: ") and error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_directory_that_is_no_study_is_left_alone(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("mine")
    assert sweep.main([*TINY, "--out", str(tmp_path)]) == 2
    assert "is not empty and holds no study" in capsys.readouterr().err


def test_dry_run_prints_the_plan(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        time_estimate, "group_seconds", lambda jobs: 60.0 * (1 + jobs[0].program.window_tokens)
    )
    monkeypatch.setattr(time_estimate, "workers", lambda: [None, None])
    assert sweep.main(["--preset", "rover", "--dry-run", "--out", str(tmp_path / "run")]) == 0
    plan, said = capsys.readouterr()
    assert "18 cells × 5 seeds = 90 lanes" in plan and "programs to compile: 18" in plan
    # 75 lanes of two minutes and 15 of td3, which has no window, of one: with two workers.
    assert "MiB" in plan and "time: about 82.5 min" in plan and "timing 4 of 4" in said


def test_the_bar_names_environments_only_if_there_are_several():
    config = Config("lstm-td3", history_length=1)
    rover, pendulum = (
        SimpleNamespace(cell=Cell(env, "none", config)) for env in ("rover", "pendulum")
    )
    assert bar_labels([rover])(rover) == "lstm-td3 l=1 none"
    assert bar_labels([rover, pendulum])(rover) == "rover none lstm-td3 l=1"


def test_presets_have_the_papers_cells():
    assert len(make_cells(PRESETS["rover"], {})) == 18
    # Four disturbances: five agents at five lengths and td3; three disturbances: two agents.
    assert len(make_cells(PRESETS["pendulum"], {})) == 4 * 26 + 3 * 10


def test_presets_have_the_settings_that_were_searched():
    def settings(preset, algorithm, **overrides):
        cells = make_cells(PRESETS[preset], overrides)
        return [cell.config.to_dict() for cell in cells if cell.config.algorithm == algorithm]

    for algorithm in ALGORITHMS:
        rover = {**presets.ROVER_SETTINGS, "total_steps": 80_000}
        length = {"history_length": 0 if algorithm == "td3" else 1}
        assert len(settings("rover", algorithm)) == 3
        assert all(found | rover | length == found for found in settings("rover", algorithm))
        pendulum = {**presets.PENDULUM_SETTINGS, "total_steps": 30_000}
        if algorithm == "h-td3":
            pendulum |= {"exploration_noise": 0.5, "policy_delay": 4, "total_steps": 60_000}
            pendulum |= {"update_every": 1, "actor_learning_rate": 3e-4, "tau": 0.005}
        assert all(found | pendulum == found for found in settings("pendulum", algorithm))
        # What is said on the command line is for all of them.
        given = {"total_steps": 2_000, "policy_delay": 3}
        assert all(f | given == f for f in settings("pendulum", algorithm, **given))


def test_a_study_may_hold_trainings_of_different_lengths(tmp_path, capsys, monkeypatch):
    settings = {"total_steps": 60, "learning_starts": 10, "batch_size": 4, "hidden_size": 4}
    tiny = {**settings, "eval_every": 30, "eval_episodes": 1}
    agents = ("td3", "lstm-td3-1ha1hc")
    grid = Grid("rover", ("ar1-slip",), agents, (2,), tiny, {"td3": {"total_steps": 90}})
    monkeypatch.setitem(PRESETS, "quick", (grid,))
    run = tmp_path / "run"
    command = ["--preset", "quick", "--seeds", "1", "--final-episodes", "2", "--out", str(run)]
    assert sweep.main(command) == 0
    curves = pd.read_parquet(run / "curves.parquet")
    assert curves.groupby("algorithm")["step"].max().to_dict() == {"td3": 90, agents[1]: 60}
    assert "- total_steps: 90 (td3); 60 (lstm-td3-1ha1hc)\n" in (run / "summary.md").read_text()
    capsys.readouterr()
    assert sweep.main([*command, "--status"]) == 0
    status = capsys.readouterr().out.splitlines()
    assert [line.split()[-2:] for line in status[:2]] == [["done", "90"], ["done", "60"]]


def test_status_names_every_lane(tmp_path, capsys):
    out = str(tmp_path / "run")
    assert sweep.main(["--out", out, "--status"]) == 2
    assert "there is no study" in capsys.readouterr().err
    assert sweep.main([*TINY, "--out", out]) == 0
    next((tmp_path / "run").glob("lanes/*td3_l0/seed-1.safetensors")).unlink()
    capsys.readouterr()
    assert sweep.main(["--out", out, "--status"]) == 0
    assert "3 done, 1 planned" in capsys.readouterr().out.replace(
        "1 planned, 3 done", "3 done, 1 planned"
    )


@pytest.mark.parametrize(
    ("text", "interval"),
    [
        ("auto", (None, None)),
        ("30s", (30.0, None)),
        ("5m", (300.0, None)),
        ("1h", (3_600.0, None)),
        ("2000steps", (math.inf, 2_000)),
    ],
)
def test_intervals_of_checkpoints(text, interval):
    assert sweep_options.parse_interval(text) == interval


def test_tables_during_a_study_hold_the_lanes_that_have_ended(tmp_path, monkeypatch):
    rows, real = [], interim.derive

    def derive(directory, *rest, **fields):
        real(directory, *rest, **fields)
        rows.append(len(read_table(directory.path / "curves.parquet", CURVES)))

    monkeypatch.setattr(interim, "SECONDS", -1.0)
    monkeypatch.setattr(interim, "derive", derive)
    assert sweep.main([*TINY, "--out", str(tmp_path / "run")]) == 0
    assert rows == [2, 4, 6, 8]  # two evaluations of each lane


def _contents(directory):
    return {
        file.relative_to(directory): file.read_bytes()
        for file in directory.rglob("*")
        if file.is_file()
    }


def test_fresh_keeps_what_was_there(tmp_path, capsys):
    out = tmp_path / "run"
    assert sweep.main([*TINY, "--out", str(out)]) == 0
    before = _contents(out)
    changed = [*TINY, "--out", str(out), "--fresh", "--gamma", "0.5"]
    assert sweep.main(changed) == 0
    assert "0.5" in (out / "summary.md").read_text()
    assert _contents(tmp_path / "run.old-1") == before
    changed[-1] = "0.25"
    assert sweep.main(changed) == 0
    assert _contents(tmp_path / "run.old-1") == before
    assert "0.5" in (tmp_path / "run.old-2" / "summary.md").read_text()


def test_fresh_does_not_rename_a_link(tmp_path, capsys):
    out, link = tmp_path / "run", tmp_path / "link"
    assert sweep.main([*TINY, "--out", str(out)]) == 0
    link.symlink_to(out)
    assert sweep.main([*TINY, "--out", str(link), "--fresh"]) == 2
    assert (
        f"is a link, and --fresh renames a directory: give --out {out}" in capsys.readouterr().err
    )
    assert sweep.main([*TINY, "--out", str(out), "--dry-run"]) == 0
    plan = capsys.readouterr().out
    assert "4 of 4 lanes have ended already" in plan and "time:" not in plan


def test_fresh_does_not_rename_the_working_directory(tmp_path, monkeypatch, capsys):
    out = tmp_path / "run"
    assert sweep.main([*TINY, "--out", str(out)]) == 0
    monkeypatch.chdir(out)
    assert sweep.main([*TINY, "--out", ".", "--fresh"]) == 2
    assert "start the command from outside" in capsys.readouterr().err
    assert len(list(out.rglob("*.safetensors"))) == 4


def test_an_empty_directory_name_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for command, first in ((sweep, TINY), (report, ["run"]), (compare, ["one", "two"])):
        assert command.main([*first, "--out", ""]) == 2
        assert "--out is empty" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_one_damaged_file_does_not_hide_the_others(tmp_path, capsys):
    out = tmp_path / "run"
    assert sweep.main([*TINY, "--out", str(out)]) == 0
    next(out.glob("lanes/*lstm*/seed-1.safetensors")).write_bytes(b"")
    with (out / "log.jsonl").open("ab") as log:
        log.write(b"\xff\n")
    capsys.readouterr()
    assert sweep.main(["--out", str(out), "--status"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert sum(" done " in line for line in lines) == 3
    assert sum(" failed " in line and "cannot be read" in line for line in lines) == 1


def test_shards_fill_one_directory_with_the_same_tables(tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert sweep.main([*TINY, "--out", str(whole)]) == 0
    for shard in ("1/3", "2/3", "3/3"):
        assert sweep.main([*TINY, "--out", str(parts), "--shard", shard]) == 0
    names = "curves.parquet", "episodes.parquet", "summary.md"
    assert _files(whole, *names) == _files(parts, *names)


@pytest.mark.parametrize("shard", ["0/2", "3/2", "a", "1/0", "-1/2"])
def test_impossible_shards_are_refused(shard, tmp_path, capsys):
    assert sweep.main([*TINY, "--out", str(tmp_path / "run"), f"--shard={shard}"]) == 2
    assert "not of the form i/n" in capsys.readouterr().err


def test_a_second_writer_is_refused_and_a_dead_one_is_not_in_the_way(tmp_path, capsys):
    from rtd3jax.study.lock import writer

    out = tmp_path / "run"
    assert sweep.main([*TINY, "--out", str(out), "--shard", "2/2"]) == 0
    with writer(out, (1, 2)):
        assert sweep.main([*TINY, "--out", str(out), "--shard", "1/3"]) == 2
        assert "another process divides the study into 2 shards" in capsys.readouterr().err
        assert sweep.main([*TINY, "--out", str(out)]) == 2
        assert "another process is writing to it" in capsys.readouterr().err
        assert sweep.main([*TINY, "--out", str(out), "--shard", "1/2"]) == 2
        assert "another process is writing shard 1/2" in capsys.readouterr().err
        assert sweep.main([*TINY, "--out", str(out), "--shard", "2/2"]) == 0
    assert sweep.main([*TINY, "--out", str(out)]) == 0


def test_a_cell_that_raises_does_not_stop_the_others(tmp_path, monkeypatch, capsys):

    real = lanes._chunk

    def chunk(group, *rest):
        cell, seed = group.jobs[0].key
        if cell.config.algorithm == "td3" and seed == 1:
            raise RuntimeError("the plant is on fire\nand more")
        real(group, *rest)

    monkeypatch.setattr(lanes, "_chunk", chunk)
    out = tmp_path / "run"
    assert sweep.main([*TINY, "--out", str(out)]) == 1
    assert "seed 1 failed: the plant is on fire" in capsys.readouterr().err
    assert sweep.main(["--out", str(out), "--status"]) == 1
    assert "failed             0  the plant is on fire" in capsys.readouterr().out
    assert "td3, l = 0, seed 1, step ?: failed: the plant" in (out / "summary.md").read_text()
    monkeypatch.setattr(lanes, "_chunk", real)
    assert sweep.main([*TINY, "--out", str(out)]) == 0


def test_a_final_evaluation_that_fails_does_not_stop_other_lanes(tmp_path, monkeypatch, capsys):
    real = recorder.both_returns

    def fails_once(policy, env, episodes, seed):
        if seed == 1 and policy.algorithm == "td3":
            raise MemoryError("out of memory")
        return real(policy, env, episodes, seed)

    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(recorder, "both_returns", fails_once)
        assert sweep.main([*TINY, "--out", str(out)]) == 1
    said = capsys.readouterr().err
    assert "rover ar1-slip td3 seed 1 failed: its final evaluation: " in said
    assert "out of memory" in said and len(list(out.glob("lanes/**/*.safetensors"))) == 3
    monkeypatch.setattr(lanes, "_chunk", lambda *_: pytest.fail("trained again"))
    assert sweep.main([*TINY, "--out", str(out)]) == 0


def test_tables_that_fail_during_a_study_do_not_stop_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(interim, "SECONDS", -1.0)

    def derive(*_, **__):
        raise UserError("a lane is damaged")

    monkeypatch.setattr(interim, "derive", derive)
    assert sweep.main([*TINY, "--out", str(tmp_path / "run")]) == 0
    assert capsys.readouterr().err.count("no tables during the training: a lane is damaged") == 1


def test_a_full_disk_is_one_line_and_loses_nothing(tmp_path, monkeypatch, capsys):
    from rtd3jax.system import files

    real, written = files.os.fsync, []

    def fsync(handle):
        written.append(handle)
        if len(written) > 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(handle)

    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", fsync)
        assert sweep.main([*TINY, "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert "No space left on device" in error and error.count("\n") == 1
    assert not list(out.rglob("*.tmp"))
    kept = {file: file.read_bytes() for file in out.glob("lanes/**/*.safetensors")}
    assert kept
    assert sweep.main([*TINY, "--out", str(out)]) == 0
    assert f"{len(kept)} of 4 lanes have ended already" in capsys.readouterr().out
    assert all(file.read_bytes() == content for file, content in kept.items())


def test_rows_of_the_log_wait_for_a_disk_that_was_full(tmp_path, monkeypatch):
    real, calls = recorder.append_rows, []

    def full_at_first(path, rows):
        calls.append(list(rows))
        if len(calls) < 4:
            with path.open("a") as log:
                log.write('{"env": ')  # a part of a line
            raise OSError(errno.ENOSPC, "No space left on device")
        real(path, rows)

    monkeypatch.setattr(recorder, "append_rows", full_at_first)
    out = tmp_path / "run"
    with pytest.warns(UserWarning, match="log.jsonl cannot be written: No space left") as warned:
        assert sweep.main([*TINY, "--out", str(out)]) == 0
    assert len([one for one in warned if "cannot be written" in str(one.message)]) == 1
    rows = read_log(out / "log.jsonl")
    assert {(row["algorithm"], row["seed"], row["step"]) for row in rows} == {
        (algorithm, seed, step)
        for algorithm in ("td3", "lstm-td3-1ha1hc")
        for seed in (0, 1)
        for step in (30, 60)
    }


def test_a_checkpoint_that_was_to_be_kept_and_cannot_be_written_costs_no_result(
    tmp_path, monkeypatch
):
    def full(*_, **__):
        raise UserError("checkpoint in x cannot be written: No space left on device")

    monkeypatch.setattr(Checkpoints, "save_lane", full)
    out = tmp_path / "run"
    with pytest.warns(UserWarning, match="No space left on device; the result is written without"):
        assert sweep.main([*TINY, "--keep-checkpoints", "--out", str(out)]) == 0
    assert len(list(out.glob("lanes/**/*.safetensors"))) == 4


def test_a_module_that_registers_environments_can_be_imported(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time_estimate, "group_seconds", lambda jobs: 1.0)
    monkeypatch.setattr(registry, "_entries", dict(registry._entries))
    (tmp_path / "own_environments.py").write_text(
        "import rtd3jax as rtd\nrtd.register('own', rtd.make('rover'))\n"
    )
    arguments = ["--env", "own", "--disturbances", "delay:steps=3", "--algorithms", "td3"]
    assert sweep.main([*arguments, "--dry-run", "--import", "own_environments"]) == 0
    assert "own        delay:steps=3" in capsys.readouterr().out
    assert sweep.main([*arguments, "--import", "no_such_environments"]) == 2
    assert "--import no_such_environments: No module named" in capsys.readouterr().err


def test_a_rover_with_faults_has_its_baselines_too():
    cell = Cell("rover", "ar1-slip+gain-drift", Config(algorithm="td3"))
    names = [row.name for row in references.references_on(cell)]
    assert names == ["random", "constant", "feedforward-pi"]
