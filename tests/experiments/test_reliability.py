"""Runs the longer experiments with --quick."""

import importlib.util
import pathlib
import sys

import jax
import pytest

EXPERIMENTS = pathlib.Path(__file__).parents[2] / "experiments"


def load(path):
    if str(EXPERIMENTS) not in sys.path:  # as when a script of this directory is started
        sys.path.insert(0, str(EXPERIMENTS))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_random_configurations_and_command_lines(capsys):
    assert load(EXPERIMENTS / "reliability" / "fuzz.py").main(["--quick"]) == 0
    assert "command lines run" in capsys.readouterr().out


def test_the_cost_of_checkpoints(capsys):
    load(EXPERIMENTS / "reliability" / "overhead.py").main(["--quick"])
    assert capsys.readouterr().out.count("%") == 1


@pytest.mark.slow
def test_killed_sweeps_resume_to_the_same_bits(monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", jax.config.jax_compilation_cache_dir)
    assert load(EXPERIMENTS / "reliability" / "kill_and_resume.py").main(["--quick"]) == 0


@pytest.mark.parametrize(
    "searched",
    [
        *("rover", "gymnasium"),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("pendulum", "one_agent")),
    ],
)
def test_the_search_runs_and_keeps_its_rows(searched, tmp_path, monkeypatch):
    if searched == "gymnasium":
        pytest.importorskip("mujoco")
    search = load(EXPERIMENTS / f"{searched}_search.py")
    monkeypatch.setattr(search, "scale", lambda name: (-1200.0, -136.0), raising=False)
    monkeypatch.setattr(search, "CHANGES", ({"gamma": 0.5},))
    out = tmp_path / "search.csv"
    search.main(["--quick", "--out", str(out)])
    rows = out.read_text().splitlines()
    assert len(rows) == 2
    monkeypatch.setattr(search, "search", lambda *_: pytest.fail("searched again"))
    search.main(["--quick", "--out", str(out)])
    assert out.read_text().splitlines() == rows
