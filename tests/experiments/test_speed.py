"""Runs the benchmarks with --quick, and tests their resume and their reports."""

import json
import re

import numpy as np
import pandas as pd
import pytest

import rtd3jax as rtd
from experiments.benchmarks import bench, lanes_on_device, products, report
from experiments.benchmarks.torch_processes import ONE_PROCESS, PROCESS_PER_CORE, ROOT
from rtd3jax.study.flops import update_flops
from rtd3jax.training import executables

QUICK = ["--quick", "--no-torch", "--out"]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    out = tmp_path_factory.mktemp("bench")
    assert bench.main([*QUICK, str(out)]) == 0
    return out


def test_the_benchmark_writes_a_table_and_a_picture(measured):
    text = (measured / "bench.md").read_text()
    assert "| lstm-td3-1ha1hc | 1 |" in text and "PyTorch |" not in text.split("goal")[0]
    assert (measured / "bench.png").read_bytes().startswith(b"\x89PNG")
    rows = pd.read_csv(measured / "measurements.csv")
    assert (rows["value"] > 0).all()
    assert set(rows["measurement"]) == {
        *(report.ours("float32"), report.compiling("float32")),
        *(report.SGEMM, report.SGEMM_NUMPY),
        *(report.LARGE_REPLAY, report.SMALL_REPLAY, report.MANY_LANES, report.FEW_LANES),
    }


def test_the_same_command_measures_nothing_twice(measured, capsys):
    before = (measured / "measurements.csv").read_bytes()
    assert bench.main([*QUICK, str(measured)]) == 0
    assert (measured / "measurements.csv").read_bytes() == before
    assert "l=1:" not in capsys.readouterr().out


def test_another_machine_is_refused_and_kept_aside(measured, monkeypatch, capsys):
    before = (measured / "measurements.csv").read_bytes()
    monkeypatch.setattr(bench, "machine", lambda: "another")
    assert bench.main([*QUICK, str(measured)]) == 2
    assert "measured on another machine" in capsys.readouterr().err
    bench.Measurements(measured / "measurements.csv", True, "another")
    assert (measured / "measurements.csv.old-1").read_bytes() == before
    (measured / "measurements.csv.old-1").rename(measured / "measurements.csv")


def test_no_step_copies_the_replay(measured):
    """The compiled program of the quick benchmark, whose capacity no other array has."""
    capacity = bench.QUICK.replay_capacity
    texts = [
        entry.executables[1].as_text()
        for (program, *_), entry in executables._programs.items()
        if program.config.replay_capacity == capacity
    ]
    assert texts
    for text in texts:
        lines = [line for line in text.splitlines() if f"[{capacity}" in line]
        assert any("dynamic-update-slice" in line for line in lines)
        assert not [line for line in lines if " copy(" in line]


def test_td3_has_one_cell():
    assert bench.cells(["td3", "h-td3"], [1, 3]) == [("td3", 0), ("h-td3", 1), ("h-td3", 3)]


def _made_up():
    """Measurements whose ratios are known: ours twice PyTorch's better way, and so on."""
    agent = report.ONE_STREAM
    rows = []

    def add(agent, length, name, *values):
        rows.extend((agent, length, name, r, v, "a machine") for r, v in enumerate(values))

    for length in (1, 3, 6, 10, 20):
        add(agent, length, report.ours("float32"), 90.0, 100.0, 110.0)
        add(agent, length, ONE_PROCESS, 5.0, 5.0, 5.0)
        add(agent, length, PROCESS_PER_CORE, 30.0, 50.0, 55.0)
        add(agent, length, report.SGEMM, 1e12, 1e12, 1e12)
        add(agent, length, report.SGEMM_NUMPY, 1e11, 1e11, 1e11)
        add("h-td3", length, report.ours("float32"), *[400.0 - length] * 3)
    add("lstm-td3", 1, report.ours("float32"), 200.0)
    add(agent, 1, report.LARGE_REPLAY, 100.0)
    add(agent, 1, report.SMALL_REPLAY, 104.0)
    add(agent, 10, report.MANY_LANES, 100.0)
    add(agent, 10, report.FEW_LANES, 110.0)
    add(agent, 10, report.CACHED, 1.0)
    return pd.DataFrame(rows, columns=report.COLUMNS)


def test_ratios_are_taken_round_by_round():
    table = report.Table(_made_up(), 128, 100)
    agent = report.ONE_STREAM
    np.testing.assert_allclose(table.against_torch(agent, 1), [3.0, 2.0, 2.0])
    assert table.torch(agent, 1)[0] == PROCESS_PER_CORE
    share = 100.0 * table.flops(agent, 20) / 1e12
    assert np.median(table.share(agent, 20)) == pytest.approx(share)
    assert table.relative_time(agent, 3, report.BASE) == pytest.approx(2.0)
    assert table.bfloat16(agent, 1) is None and table.against_torch("h-td3", 1) is None


def test_goals_are_judged():
    goals = {goal.what: goal for goal in report.goals(report.Table(_made_up(), 128, 100))}

    def goal(start):
        return next(goal for what, goal in goals.items() if what.startswith(start))

    assert goal("rate over PyTorch's, lstm-td3-1ha1hc, l = 1").met is False
    assert goal("rate over PyTorch's, lstm-td3-1ha1hc, geometric").value == pytest.approx(2.0)
    assert goal("h-td3's rate").value == pytest.approx(3.8) and goal("h-td3's rate").met
    assert goal("step time").value == pytest.approx(1.04) and goal("step time").met
    assert goal("time per lane").met is False
    assert goal("bfloat16").met is None and goal("compiling").met is None
    assert goal("the same from").met
    text = report.markdown(_made_up(), 128, 100)
    assert "shortest iteration of the recurrent agents at 5 of 5" not in text  # lengths missing
    assert "| step time, replay of 1,000,000 over 10,000, l = 1 | ≤ 1.05 | 1.04 | yes |" in text


def test_the_papers_claim_is_judged():
    rows = _made_up()
    text = report.markdown(rows[rows["agent"] != "lstm-td3"], 128, 100)
    assert "recurrent agents at 5 of 5 lengths" in text
    assert "grows least in lstm-td3-1ha1hc" in text  # whose made-up rate does not fall at all


@pytest.mark.slow
def test_lanes_on_a_device_quick(tmp_path):
    out = tmp_path / "lanes.md"
    assert lanes_on_device.main(["--quick", "--out", str(out)]) == 0
    lines = out.read_text().splitlines()
    assert "cpu" in lines[0] and lines[-1].startswith("| 2 |")
    assert lanes_on_device.parse([]).lanes[-1] == 1024


@pytest.mark.parametrize("agent", ["td3", "lstm-td3", "h-td3"])
def test_the_torch_worker_trains(agent):
    pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[bench]'")
    from experiments.benchmarks.torch_worker import Worker

    worker = Worker()
    order = {"seeds": [0, 1], "warm_up": 2, "learning_starts": 210, "agent": agent}
    sizes = {"width": 4, "batch": 5, "capacity": 100, "history_length": 3 * (agent != "td3")}
    assert json.loads(json.dumps(worker.prepare(**order, **sizes))) == {"seeds": 2}
    answer = worker.run(0.01)
    assert answer["steps"] > 0 and answer["seconds"] >= 0.01


def test_the_documentations_counts_are_those_of_the_code(capsys):
    text = (ROOT / "docs" / "how_it_is_fast.md").read_text()
    (block,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    exec(compile(block, "how_it_is_fast.md", "exec"), {})
    shown = [line.removeprefix("# ") for line in block.splitlines() if line.startswith("# ")]
    assert capsys.readouterr().out.splitlines() == shown


@pytest.mark.parametrize("length", [1, 6, 20])
def test_the_products_timed_alone_are_those_that_are_counted(length):
    config = rtd.Config(products.AGENT, length)
    listed = products.products_of(length, config.batch_size, config.hidden_size)
    total = sum(product.count * product.flops for product in listed)
    assert total == pytest.approx(update_flops(config), rel=1e-9)


def test_products_alone_run(tmp_path):
    products.main(["--quick", "--out", str(tmp_path)])
    assert "products alone" in (tmp_path / "products.md").read_text()
