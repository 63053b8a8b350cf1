"""The benchmarks run, in their quick form."""

import csv
import importlib
import pathlib
import re
import runpy

ROOT = pathlib.Path(__file__).parents[2]


def test_latency(tmp_path, monkeypatch):
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, "1")
    main = runpy.run_path(str(ROOT / "experiments" / "benchmarks" / "latency.py"))["main"]
    assert main(["--quick", "--out", str(tmp_path)]) == 0
    with (tmp_path / "latency.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len({(r["agent"], r["form"]) for r in rows}) == 2 * 4
    assert all(float(row["us"]) > 0 for row in rows)
    text = (tmp_path / "latency.md").read_text()
    assert all(f"| `{agent}` |" in text for agent in ("td3", "lstm-td3"))


def test_profile(tmp_path):
    profile = importlib.import_module("experiments.benchmarks.profile")
    profile.main(["--quick", "--lengths", "1", "--out", str(tmp_path)])
    rows = dict(
        re.findall(r"^\| ([^*|]+) \| (\d+) \|", (tmp_path / "profile.md").read_text(), re.MULTILINE)
    )
    learning = (profile.PRODUCTS, profile.LSTM, profile.OPTIMISERS, profile.ACTING)
    assert all(int(rows[purpose]) > 0 for purpose in learning)


def test_own_time_is_counted_once():
    profile = importlib.import_module("experiments.benchmarks.profile")
    event = {"ph": "X", "pid": 1, "tid": 1}
    events = [
        {**event, "name": "while", "ts": 0.0, "dur": 10.0},
        {**event, "name": "dot.1", "ts": 1.0, "dur": 4.0},
        {**event, "name": "unknown", "ts": 6.0, "dur": 3.0},
        {**event, "name": "dot.2", "ts": 7.0, "dur": 1.0},
        {**event, "name": "dot.1", "ts": 2.0, "dur": 2.0, "tid": 2},
    ]
    times = profile.own_times(events, {"dot.1": "a", "dot.2": "b"})
    assert times == {"a": 6.0, "b": 1.0, profile.RUNTIME: 3.0}


def test_the_guide_shows_the_measured_table():
    measured = (ROOT / "experiments" / "results" / "benchmarks" / "latency.md").read_text()
    table = "".join(line for line in measured.splitlines(True) if line.startswith("|"))
    guide = (ROOT / "docs" / "deploy_a_policy.md").read_text()
    assert table in guide, "copy the table of latency.md to docs/deploy_a_policy.md"
