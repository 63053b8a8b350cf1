"""The longer experiments run, in their quick form."""

import importlib.util
import pathlib

EXPERIMENTS = pathlib.Path(__file__).parents[2] / "experiments"


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_killed_sweeps_resume_to_the_same_bits():
    assert load(EXPERIMENTS / "reliability" / "kill_and_resume.py").main(["--quick"]) == 0


def test_the_search_runs(tmp_path, monkeypatch):
    search = load(EXPERIMENTS / "rover_search.py")
    monkeypatch.setattr(
        search, "GRID", {"gamma": (0.9,), "learning_rate": (1e-3,), "exploration_noise": (0.1,)}
    )
    search.main(["--quick"], tmp_path / "search.csv")
    assert len((tmp_path / "search.csv").read_text().splitlines()) == 2
