"""The command: what it writes, what it refuses, and that it goes on where it stopped."""

import json

import jax
import numpy as np
import pytest

from rtd3jax import sweep
from rtd3jax.study.plan import PRESETS, make_cells
from rtd3jax.study.results import CURVES, EPISODES, read_table

TINY = [
    *("--env", "rover", "--disturbances", "ar1-slip", "--algorithms", "td3", "lstm-td3-1ha1hc"),
    *("--history-lengths", "2", "--seeds", "2", "--total-steps", "60", "--hidden-size", "4"),
    *("--batch-size", "4", "--learning-starts", "10", "--eval-every", "30"),
    *("--eval-episodes", "1", "--final-episodes", "2", "--quiet"),
]


@pytest.fixture(autouse=True)
def few_reference_episodes(monkeypatch):
    monkeypatch.setattr(sweep, "REFERENCE_EPISODES", 2)


def _files(directory, *names):
    return [(directory / name).read_bytes() for name in names]


def test_a_run_directory_holds_what_it_should(tmp_path, capsys):
    out = tmp_path / "run"
    assert sweep.main([*TINY, "--out", str(out)]) == 0
    curves = read_table(out / "curves.parquet", CURVES)
    assert len(curves) == 2 * 2 * 2 and set(curves["step"]) == {30, 60}
    episodes = read_table(out / "episodes.parquet", EPISODES)
    assert set(episodes["algorithm"]) == {"td3", "lstm-td3-1ha1hc", "random", "constant"}
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
    assert sweep.main([*TINY, "--out", str(out)]) == 0
    assert "3 of 4 lanes are there already" in capsys.readouterr().out
    assert lane.read_bytes() == kept and _files(out, *tables) == before

    # Another study does not go there; a broken lane is named.
    assert sweep.main([*TINY, "--out", str(out), "--gamma", "0.9"]) == 2
    assert "holds another study (gamma: 0.99 there, 0.9 here)" in capsys.readouterr().err
    lane.write_bytes(kept[:100])
    assert sweep.main([*TINY, "--out", str(out)]) == 2
    assert "seed-1.safetensors cannot be read" in capsys.readouterr().err


def test_an_interrupt_leaves_a_readable_directory(tmp_path, monkeypatch):
    real = sweep._Recorder.update
    calls = []

    def interrupted(self, group):
        real(self, group)
        calls.append(group)
        if group.finished:
            raise KeyboardInterrupt

    monkeypatch.setattr(sweep._Recorder, "update", interrupted)
    out = tmp_path / "run"
    assert sweep.main([*TINY, "--out", str(out)]) == 130
    assert len(read_table(out / "curves.parquet", CURVES)) == 2
    monkeypatch.setattr(sweep._Recorder, "update", real)
    assert sweep.main([*TINY, "--out", str(out)]) == 0
    assert len(read_table(out / "curves.parquet", CURVES)) == 8


def test_a_lost_lane_is_reported_and_the_exit_status_says_so(tmp_path, capsys):
    arguments = [*TINY, "--out", str(tmp_path / "run"), "--critic-learning-rate", "1e30"]
    assert sweep.main(arguments) == 1
    captured = capsys.readouterr()
    assert "lost at step" in captured.err and "lower actor_learning_rate" in captured.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "say what to run"),
        ("--env rovr", "rover"),
        ("--env rover --disturbances ar1-slipp", "ar1-slip"),
        ("--env rover --algorithms h-td", "did you mean 'h-td3'"),
        ("--env CartPole-v1", "action"),
        ("--preset quick --seeds 0", "seeds must be at least 1"),
        ("--preset quick --total-steps -1", "total_steps must be at least 1"),
        ("--preset quick --batch-size 5000", "batch_size"),
        ("--env pendulum --disturbances noise:sigma=-1", "sigma"),
        ("--preset quick --device gpu", "--device gpu: there is none here"),
        ("--preset quick --hidden-size 200000", "one lane needs"),
        ("--preset quick --history-lengths 0", "history_length must be at least 1"),
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


def test_dry_run_prints_the_plan(tmp_path, capsys):
    assert sweep.main(["--preset", "rover", "--dry-run", "--out", str(tmp_path / "run")]) == 0
    plan = capsys.readouterr().out
    assert "18 cells × 5 seeds = 90 lanes" in plan and "programs to compile: 6" in plan
    assert "MiB" in plan and "time: about" in plan


def test_presets_have_the_papers_cells():
    assert len(make_cells(PRESETS["rover"], {})) == 18
    # Four disturbances: five agents at five lengths and td3; two disturbances: two agents.
    assert len(make_cells(PRESETS["pendulum"], {})) == 4 * 26 + 2 * 10
