"""The benchmarks run, in their quick form."""

import csv
import pathlib
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


def test_the_guide_shows_the_measured_table():
    measured = (ROOT / "experiments" / "results" / "benchmarks" / "latency.md").read_text()
    table = "".join(line for line in measured.splitlines(True) if line.startswith("|"))
    guide = (ROOT / "docs" / "deploy_a_policy.md").read_text()
    assert table in guide, "copy the table of latency.md to docs/deploy_a_policy.md"
