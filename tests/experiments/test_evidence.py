"""The experiments run in their quick form, and the verdicts follow from the numbers."""

import sys

import numpy as np
import pandas as pd
import pytest
from test_reliability import EXPERIMENTS, load

from rtd3jax import sweep


@pytest.fixture(autouse=True)
def leave_the_path_alone(monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sweep, "REFERENCE_EPISODES", 2)


def test_the_rover_experiment_runs_and_says_what_is_missing(tmp_path, capsys):
    rover = load(EXPERIMENTS / "rover.py")
    run, out = tmp_path / "run", tmp_path / "out"
    assert rover.main(["--quick", "--run", str(run), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "not trained yet" in printed and "missing: " in printed
    table = pd.read_parquet(out / "rover.parquet")
    assert len(table) == 1 and set(table["algorithm"]) == {"td3"}
    assert (out / "rover.png").stat().st_size > 5_000
    assert "-1.36 ± 0.04" in (out / "rover.md").read_text()

    pictures = load(EXPERIMENTS / "rover_pictures.py")
    assert pictures.main(["--quick", "--run", str(run), "--out", str(out)]) == 0
    assert "missing: " in capsys.readouterr().out
    assert (out / "rover_inferred_slip.png").exists()
    assert (out / "rover_drive.gif").read_bytes().startswith(b"GIF")


@pytest.mark.parametrize("name", ["slip_distributions", "parameter_counts"])
def test_small_experiments_run(name, tmp_path):
    load(EXPERIMENTS / f"{name}.py").main(["--quick", "--out", str(tmp_path)])
    assert (tmp_path / f"{name}.md").exists() and (tmp_path / f"{name}.parquet").exists()


def test_the_papers_counts_are_met(tmp_path):
    load(EXPERIMENTS / "parameter_counts.py").main(["--out", str(tmp_path)])
    table = pd.read_parquet(tmp_path / "parameter_counts.parquet").dropna()
    assert len(table) == 5
    assert (table["actor"] == table["paper_actor"]).all()
    assert (table["critic"] == table["paper_critic"]).all()


def test_verdicts_follow_from_the_numbers():
    claims = load(EXPERIMENTS / "claims.py")
    good, bad = np.array([-1.3, -1.31, -1.29]), np.array([-2.9, -3.0, -2.8])
    wide = np.array([-1.0, -3.0, -2.0])
    assert claims.Effect("", good, bad).verdict() == "supported"
    assert claims.Effect("", bad, good).verdict() == "contradicted"
    assert claims.Effect("", good, wide).verdict() == "undecided"
    assert claims.Effect("", good[:2], bad).verdict() == "undecided"
    assert claims.combine(["supported", "undecided"]) == "undecided"
    assert claims.combine(["supported", "contradicted"]) == "contradicted"
    assert claims.combine([]) == "undecided"
    mean, low, high = claims.Effect("", good, bad).interval()
    assert mean == pytest.approx(1.6) and low < mean < high


def test_claims_without_results_are_undecided(tmp_path, capsys):
    load(EXPERIMENTS / "claims.py").main(["--results", str(tmp_path), "--out", str(tmp_path)])
    table = pd.read_parquet(tmp_path / "claims.parquet")
    assert len(table) == 15 and set(table["verdict"]) == {"undecided"}
    assert capsys.readouterr().out.count("not run yet") == 15
