"""Runs the benchmarks with --quick."""

import csv
import importlib
import pathlib
import re
import runpy

import pandas as pd
import pytest

ROOT = pathlib.Path(__file__).parents[2]


def test_latency(tmp_path, monkeypatch):
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, "1")
    main = runpy.run_path(str(ROOT / "experiments" / "benchmarks" / "latency.py"))["main"]
    assert main(["--quick", "--out", str(tmp_path)]) == 0
    with (tmp_path / "latency.csv").open() as file:
        rows = list(csv.DictReader(file))
    # td3 has no window; lstm-td3 acts in both ways.
    assert len(rows) == len({(r["agent"], r["acting"], r["form"]) for r in rows}) == 3 * 5
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


@pytest.mark.parametrize(
    "measured, guide",
    [("latency.md", "deploy_a_policy.md"), ("zen2/bounds.md", "how_it_is_fast.md")],
)
def test_the_guide_shows_the_measured_table(measured, guide):
    text = (ROOT / "experiments" / "results" / "benchmarks" / measured).read_text()
    table = "".join(line for line in text.splitlines(True) if line.startswith("|"))
    shown = (ROOT / "docs" / guide).read_text()
    assert table in shown, f"copy the table of {measured} to docs/{guide}"


def test_bounds(tmp_path, capsys):
    bounds = importlib.import_module("experiments.benchmarks.bounds")
    report = importlib.import_module("experiments.benchmarks.report")
    arguments = ["--quick", "--lengths", "1", "--out", str(tmp_path)]
    assert bounds.main(arguments) == 2
    assert "run python -m experiments.benchmarks.bench first" in capsys.readouterr().err

    values = {report.ours("float32"): 400.0, report.PROCESS_PER_CORE: 200.0, report.SGEMM: 4e11}
    rows = [(bounds.AGENT, 1, name, 0, value, "another") for name, value in values.items()]
    path = tmp_path / "measurements.csv"
    pd.DataFrame(rows, columns=report.COLUMNS).to_csv(path, index=False)
    assert bounds.main(arguments) == 2
    assert "another machine (another)" in capsys.readouterr().err

    own = [(*row[:-1], bounds.machine()) for row in rows]
    pd.DataFrame(own, columns=report.COLUMNS).to_csv(path, index=False)
    assert bounds.main(arguments) == 0
    (row,) = pd.read_csv(tmp_path / "bounds.csv").to_dict("records")
    assert row["ratio"] == 2.0 and row["torch"] == 5.0
    assert min(row[part] for part in ("products", "gates", "optimisers")) > 0
    assert "| geometric mean |" in (tmp_path / "bounds.md").read_text()
    assert bounds.main([*arguments, "--lengths", "3"]) == 2
    assert "PyTorch at l = 3; run" in capsys.readouterr().err


def test_a_bound_is_what_products_gates_and_optimisers_leave():
    bounds = importlib.import_module("experiments.benchmarks.bounds")
    parts = {"products": 1.0, "gates": 0.5, "optimisers": 0.25}
    known = {"torch": 3.5, "large": 1e12}
    assert bounds.bound(parts, known, 7e8) == {"ratio_bound": 2.0, "share_bound": 0.4}
