"""Runs the experiments with --quick."""

import argparse
import json
import re
import shutil
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from test_reliability import EXPERIMENTS, load

from rtd3jax.envs.rover_soil.soil import Soil, local_soil
from rtd3jax.envs.rover_soil.wheel import contact_forces, entry_angle

pytestmark = pytest.mark.usefixtures("leave_the_path_alone")


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

    # What another setting gave stays where this one gave nothing, and is marked.
    now = table["setting"][0]  # which the run's configuration says
    assert now.endswith("--total-steps=60")
    earlier = table.assign(setting="--earlier", mean=-9.0)
    known = pd.concat([earlier, earlier.assign(algorithm="h-td3")])
    rows, _ = rover.evaluate_policies(run, 20, known, now)
    means = rows.set_index("algorithm")["mean"]
    assert means["td3"] == table["mean"][0] and means["h-td3"] == -9.0
    others = {"ceiling": dict.fromkeys((tested for _, tested in rover.COLUMNS), "0")}
    text = rover.table(rows, others, now)
    assert "-9.00 (1 of 5 seeds) †" in text and text.endswith("† trained with --earlier")
    again, _ = rover.evaluate_policies(tmp_path / "nothing", 20, rows, now)
    pd.testing.assert_frame_equal(again, rows)

    pictures = load(EXPERIMENTS / "rover_pictures.py")
    assert pictures.main(["--quick", "--run", str(run), "--out", str(out)]) == 0
    assert "missing: " in capsys.readouterr().out
    assert (out / "rover_inferred_slip.png").exists()
    assert (out / "rover_drive.gif").read_bytes().startswith(b"GIF")


@pytest.mark.slow
def test_the_rover_on_soil_meets_agents_of_the_rover(tmp_path, capsys):
    soil = load(EXPERIMENTS / "rover_soil.py")
    command = ["--quick", "--run", str(tmp_path / "run"), "--out", str(tmp_path)]
    assert soil.main(command) == 0
    rows = pd.read_parquet(tmp_path / "rover_soil.parquet")
    ways = set(zip(rows["trained_on"], rows["tested_on"], strict=True))
    ground = "mixed"
    assert {("sine-slip", ground), (ground, ground), (ground, "sine-slip")} <= ways
    assert ("no training", ground) in ways and np.isfinite(rows["mean"]).all()
    said = capsys.readouterr().out
    assert "has 0 of 4 cells" in said and "not trained yet" in said and "undecided" in said

    command[2] = str(tmp_path / "elsewhere")  # what the table has is neither trained nor tested
    assert soil.main(command) == 0
    assert "has 4 of 4 cells" in capsys.readouterr().out
    again = pd.read_parquet(tmp_path / "rover_soil.parquet")
    pd.testing.assert_frame_equal(again, rows)


def test_the_report_of_the_rover_on_soil(tmp_path):
    report = load(EXPERIMENTS / "rover_soil_report.py")
    ways = [("sine-slip", "mixed", -1.0), ("ar1-slip", "mixed", -0.5), ("mixed", "mixed", -0.1)]
    rows = [
        {"algorithm": agent, "trained_on": there, "tested_on": here, "seed": s, "mean": mean * k}
        for k, agent in enumerate(("lstm-td3-1ha1hc", "td3"), start=1)
        for there, here, mean in ways
        for s in range(3)
    ]
    rows += [
        {"algorithm": name, "trained_on": "no training", "tested_on": "mixed", "seed": s, "mean": m}
        for name, m in (
            ("feed-forward and PI", -0.2),
            ("adaptive slip estimate", -0.3),
            ("constant command", -1.2),
        )
        for s in range(3)
    ]
    rows = pd.DataFrame(rows)
    text = report.tables(rows, ("mixed",), 3)
    assert "| td3 | -1.000 [-1.000, -1.000] | -2.000 [-2.000, -2.000] | -0.200" in text
    assert "| *feed-forward and PI* |  |  |  | -0.200" in text
    # The margin is 2% of the distance from -1.2 to -0.2.
    line = (
        "| mixed | ±0.020 | undecided | over td3: +1.000 [+1.000, +1.000]; over lstm-td3: too few"
    )
    assert line in text
    assert "| mixed | td3: mixed over sine-slip: +1.800 [+1.800, +1.800] | supported |" in text
    assert "td3: sine-slip over feed-forward and PI: -1.800" in text
    report.draw(rows, ("mixed",), tmp_path)
    assert (tmp_path / "rover_soil.png").read_bytes().startswith(b"\x89PNG")


def test_the_cost_of_a_step_on_soil_is_said(capsys):
    load(EXPERIMENTS / "rover_soil_cost.py").main(["--quick"])
    assert "rover-soil mixed-slope: step_env" in capsys.readouterr().out


def test_the_prediction_of_a_pull_is_that_of_the_rover_on_soil():
    experiment = load(EXPERIMENTS / "rover_soil_pull.py")
    published = experiment.PUBLISHED
    soil = Soil(*published[:3], 15.6e3, 2407.4e3, published.exponent, *published[5:8])
    local = jax.tree.map(lambda part: jnp.full((6,), part), local_soil(soil, 0.165))
    slip, load_ = jnp.asarray(experiment.SLIP, jnp.float32), jnp.full((6,), experiment.LOAD)
    entry = entry_angle(local, experiment.WHEEL, load_, slip)
    found = contact_forces(local, experiment.WHEEL, entry, slip)
    pull, torque, sinkage = experiment.prediction(np.array(published))
    np.testing.assert_allclose(pull, found.pull, atol=0.01)
    np.testing.assert_allclose(torque, found.torque, rtol=1e-3)
    np.testing.assert_allclose(sinkage, 0.15735 * (1 - np.cos(entry)), rtol=1e-3)


@pytest.mark.parametrize(
    "name",
    [
        "slip_distributions",
        "parameter_counts",
        "rover_soil_pull",
        "sizing",
        pytest.param("filter_reference", marks=pytest.mark.slow),
        pytest.param("memories", marks=pytest.mark.slow),
        pytest.param("segments_returns", marks=pytest.mark.slow),
        pytest.param("many_environments", marks=pytest.mark.slow),
        pytest.param("fine_tuning", marks=pytest.mark.slow),
        pytest.param("rover_soil_gains", marks=pytest.mark.slow),
        pytest.param("one_step_episodes", marks=pytest.mark.slow),
        pytest.param("benchmarks/gates", marks=pytest.mark.slow),
    ],
)
def test_small_experiments_run(name, tmp_path):
    load(EXPERIMENTS / f"{name}.py").main(["--quick", "--out", str(tmp_path)])
    name = name.rpartition("/")[2]
    assert (tmp_path / f"{name}.md").exists() and (tmp_path / f"{name}.parquet").exists()


def test_the_papers_counts_are_met(tmp_path):
    load(EXPERIMENTS / "parameter_counts.py").main(["--out", str(tmp_path)])
    table = pd.read_parquet(tmp_path / "parameter_counts.parquet").dropna()
    assert len(table) == 5
    assert (table["actor"] == table["paper_actor"]).all()
    assert (table["critic"] == table["paper_critic"]).all()


def test_longer_windows_of_the_rover_are_trained_once(tmp_path, capsys):
    experiment = load(EXPERIMENTS / "rover_lengths.py")
    shutil.copy(EXPERIMENTS / "results" / "rover.parquet", tmp_path)
    quick = ["--quick", "--out", str(tmp_path)]
    assert experiment.main([*quick, "--run", str(tmp_path / "run")]) == 0
    rows = pd.read_parquet(tmp_path / "rover_lengths.parquet")
    assert list(rows["history_length"]) == [3] and list(rows["steps"]) == [60]
    said = capsys.readouterr().out
    assert "has 0 of 1 cells" in said and f"{rows['mean'][0]:.3f} (1 of 5 seeds)" in said
    # Window 1 and td3 come from the rover's own table.
    assert "| ar1-slip | lstm-td3-1ha1hc | -1.245" in said
    assert "-2.916 ± 0.025 | no window |" in said
    assert (tmp_path / "rover_lengths.png").stat().st_size > 5_000

    assert experiment.main([*quick, "--run", str(tmp_path / "elsewhere")]) == 0
    assert "has 1 of 1 cells" in capsys.readouterr().out
    assert not (tmp_path / "elsewhere").exists()


def test_longer_trainings_of_the_rover_stand_beside_those_of_its_table(tmp_path, capsys):
    experiment = load(EXPERIMENTS / "rover_longer.py")
    shutil.copy(EXPERIMENTS / "results" / "rover.parquet", tmp_path)
    quick = ["--quick", "--algorithms", "td3", "--out", str(tmp_path)]
    assert experiment.main([*quick, "--run", str(tmp_path / "run")]) == 0
    mean = pd.read_parquet(tmp_path / "rover_longer.parquet")["mean"][0]
    text = (tmp_path / "rover_longer.md").read_text()
    ceiling = float(re.search(r"In the same episodes, the ceiling is (-\d\.\d+) ", text)[1])
    row = re.search(r"td3 \| (-2.916) ± 0.025 \| (.*)% \| (.*) \(1 of 5 seeds\) \| (.*)% \|", text)
    before, below, after, further = map(float, row.groups())
    assert after == pytest.approx(mean, abs=6e-4)
    assert below == pytest.approx(100 * (before / ceiling - 1), abs=0.2)
    assert further == pytest.approx(100 * (after / ceiling - 1), abs=0.2 * after / ceiling)
    capsys.readouterr()
    assert experiment.main([*quick, "--run", str(tmp_path / "elsewhere")]) == 0
    assert "has 1 of 1 cells" in capsys.readouterr().out


def test_facts_name_the_agents_with_other_numbers_of_steps():
    pendulum = load(EXPERIMENTS / "pendulum.py")
    cells = [("td3", 30_000), ("lstm-td3", 30_000), ("lstm-td3", 30_000), ("h-td3", 60_000)]
    lanes = pd.DataFrame(cells, columns=["algorithm", "steps"])
    assert pendulum.of_each(lanes, "steps") == "30,000; h-td3: 60,000"
    assert pendulum.of_each(lanes[lanes["algorithm"] == "td3"], "steps") == "30,000"


def test_a_cell_states_another_number_of_seeds():
    pendulum = load(EXPERIMENTS / "pendulum.py")
    setting = pendulum.current_setting("td3")
    lanes = pd.DataFrame({"algorithm": "td3", "history_length": 0, "normalised": 0.5}, range(15))
    lanes = lanes.assign(disturbance=["noise"] * 5 + ["hidden"] * 10, setting=setting)
    text = pendulum.table(lanes, "disturbance", ("noise", "hidden"), {})
    assert "| td3 | – | 0.500 ± 0.000 | 0.500 ± 0.000 (10) |" in text


def test_failed_trainings_are_counted_under_the_disturbances_of_all_agents():
    pendulum = load(EXPERIMENTS / "pendulum.py")
    now = pendulum.current_setting
    rows = [
        ("td3", "noise", -0.2, now("td3")),
        ("td3", "hidden", 0.0, now("td3")),
        ("td3", "noise:sigma=1.0", -0.5, now("td3")),  # the paper only has two agents there
        ("td3", "noise", -0.2, "an earlier setting"),
        ("h-td3", "hidden", -0.09, now("h-td3")),
    ]
    lanes = pd.DataFrame(rows, columns=["algorithm", "disturbance", "normalised", "setting"])
    assert pendulum.failed(lanes) == {"h-td3": "0 of 1", "td3": "1 of 2"}


def test_the_pendulum_experiment_runs(tmp_path, capsys, monkeypatch):
    pendulum = load(EXPERIMENTS / "pendulum.py")
    best = pendulum.rtd.Ceiling(-136.0, 0.5, "exact")
    monkeypatch.setattr(pendulum.rtd, "ceiling", lambda env: best)
    monkeypatch.setattr(pendulum, "REFERENCE_EPISODES", 2)
    monkeypatch.setattr(pendulum, "CONDITIONS", ("random-sine",))
    run, out = tmp_path / "run", tmp_path / "out"
    quick = ["--quick", "--algorithms", "td3", "--out", str(out)]
    assert pendulum.main([*quick, "--run", str(run)]) == 0
    table = pd.read_parquet(out / "pendulum.parquet").set_index("algorithm")
    assert set(table.index) == {"td3"} and np.isfinite(table["normalised"]).all()
    assert set(pd.read_parquet(out / "generalisation.parquet")["algorithm"]) == {"td3"}
    assert (out / "pendulum.png").stat().st_size > 5_000
    assert (out / "pendulum_learning_curves.svg").stat().st_size > 5_000
    said = capsys.readouterr().out
    assert "has 0 of 1 cells" in said and "not run" in said and "†" not in said

    # What stands in the table is not trained again, wherever it was trained, but written again.
    monkeypatch.setattr(pendulum, "draw_all", lambda *_: None)
    elsewhere = tmp_path / "elsewhere"
    tables = [out / f"{name}.md" for name in ("pendulum", "generalisation")]
    before = [file.read_text().partition("- minutes")[0] for file in tables]
    for file in tables:
        file.unlink()
    assert pendulum.main([*quick, "--run", str(elsewhere)]) == 0
    assert "has 1 of 1 cells" in capsys.readouterr().out and not elsewhere.exists()
    assert [file.read_text().partition("- minutes")[0] for file in tables] == before

    # A further seed joins those of the table. In the study of the others, they would be continued.
    with pytest.raises(SystemExit, match=r"holds other seeds \(0 to 0\).* choose another --run"):
        pendulum.main([*quick, "--first-seed", "1", "--run", str(run)])
    assert pendulum.main([*quick, "--first-seed", "1", "--run", str(tmp_path / "further")]) == 0
    assert sorted(pd.read_parquet(out / "pendulum.parquet")["seed"]) == [0, 1]
    capsys.readouterr()

    # Without a finished lane of random-sine there is nothing to carry over, and that is said.
    lanes = run / "lanes"
    lanes.rename(run / "aside")
    again = ["--report", "--run", str(run)]
    assert pendulum.main([*quick, *again]) == 0
    assert "missing: trained on random-sine" in capsys.readouterr().out
    (run / "aside").rename(lanes)

    # A training that two directories hold counts once, and only one number of steps is compared.
    shutil.copytree(run, tmp_path / "both" / "one")
    shutil.copytree(run, tmp_path / "both" / "two")
    assert pendulum.main([*quick, "--report", "--run", str(tmp_path / "both")]) == 0
    assert sorted(pd.read_parquet(out / "pendulum.parquet")["seed"]) == [0, 1]
    with pytest.raises(SystemExit):
        pendulum.main(["--steps", "60000", "--report"])
    assert "with --steps 60000, choose another --out" in capsys.readouterr().err

    # Cells of a table from before settings were noted stay, and are marked.
    table.reset_index().drop(columns=["setting", "episodes"]).to_parquet(out / "pendulum.parquet")
    (out / "generalisation.parquet").unlink()
    more = ["--disturbances", "hidden", "--algorithms", "td3", "--run", str(tmp_path / "more")]
    assert pendulum.main([*quick, *more]) == 0
    both = pd.read_parquet(out / "pendulum.parquet").set_index(["algorithm", "disturbance"])
    assert set(both.index) == {(a, "random-sine") for a in table.index} | {("td3", "hidden")}
    assert both["mean"][("td3", "random-sine")] == table["mean"]["td3"]
    said = capsys.readouterr().out
    assert "missing: generalisation" in said and said.count("†") == 2
    assert "† trained with the configuration's defaults" in said
    # Before the first lane ends there is nothing to report.
    shutil.rmtree(tmp_path / "more" / "lanes")
    assert pendulum.main([*quick, *more, "--report"]) == 0
    assert "nothing is trained" in capsys.readouterr().out
    assert pendulum.main([*quick, *more, "--report", "--out", str(tmp_path / "empty")]) == 1

    pictures = load(EXPERIMENTS / "pendulum_pictures.py")
    assert pictures.main(["--quick", "--run", str(run), "--out", str(out)]) == 0
    assert "missing: " in capsys.readouterr().out
    assert (out / "pendulum_swing.gif").read_bytes().startswith(b"GIF")


def test_the_sixth_agent_has_a_setting_of_its_own_and_twice_the_steps():
    load(EXPERIMENTS / "pendulum.py")
    module = sys.modules["pendulum_cells"]
    names = {"algorithms": ["lstm-td3", "h-td3"], "disturbances": ["hidden"], "lengths": [6]}
    options = argparse.Namespace(**names, steps=2_000, width=8)
    one, other = (cell.config for cell in module.cells(options, {}))
    assert (one.total_steps, other.total_steps) == (2_000, 4_000)
    assert (one.capacity, other.capacity) == (2_000, 20_000)
    assert "--replay-capacity=20000" in module.current_setting("h-td3")


@pytest.mark.parametrize("name, of_a_lane", [("pendulum", 1), ("generalisation", 5)])
def test_the_pendulums_tables_state_what_their_files_hold(name, of_a_lane):
    """Tables, pictures and claims are of the same trainings."""
    facts = json.loads((EXPERIMENTS / "results" / f"{name}.json").read_text())
    rows = len(pd.read_parquet(EXPERIMENTS / "results" / f"{name}.parquet"))
    assert facts["lanes"] * of_a_lane == rows and facts["width"] == "128"


@pytest.mark.slow
def test_pairs_of_precisions_are_compared(tmp_path):
    pairs = load(EXPERIMENTS / "bfloat16_returns.py")
    options = ["--quick", "--run", str(tmp_path / "run"), "--out", str(tmp_path)]
    assert pairs.main(options) == 0
    table = pd.read_parquet(tmp_path / "bfloat16_returns.parquet")
    np.testing.assert_allclose(table["difference"], table["bfloat16"] - table["float32"])
    assert len(table) == 2 and "Mean difference" in (tmp_path / "bfloat16_returns.md").read_text()
    # Twice the spread needs twice the interval, and five equal differences none.
    mean, low, high = pairs.mean_interval(np.array([0.1, 0.3, 0.2, 0.2, 0.2]))
    assert mean == pytest.approx(0.2) and low == pytest.approx(0.2 - 0.0878, abs=1e-4)
    assert high == pytest.approx(0.2 + 0.0878, abs=1e-4)


@pytest.mark.slow
def test_a_log_becomes_an_exported_policy(tmp_path, capsys):
    script = load(EXPERIMENTS / "from_a_log.py")
    script.main(["--quick", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "trained on the recording: -" in printed and "ar1: Ar1Slip" in printed
    assert (tmp_path / "fit.png").stat().st_size > 10_000
    player = load(tmp_path / "policy.py").Player()
    player.reset()
    assert np.all(np.abs(player.step([-0.5, 0.0])) <= 1.0)
    assert len((EXPERIMENTS / "from_a_log.py").read_text().splitlines()) <= 90


@pytest.mark.slow
def test_a_log_with_noise_and_a_halt_becomes_an_exported_policy(tmp_path, capsys):
    script = load(EXPERIMENTS / "from_a_log.py")
    log = pd.read_csv(script.drive(tmp_path, 10))
    noise = np.random.default_rng(0).normal(0.0, 0.02, (len(log), 2))
    log[["realised_left", "realised_right"]] += noise
    log.loc[500:520, ["commanded_left", "realised_left"]] = 0.0
    log.to_csv(tmp_path / "noisy.csv", index=False)
    slip = script.slip_of(tmp_path / "noisy.csv")
    assert len(slip.lengths) == 12 and np.isfinite(slip.values).all() and slip.values.min() < 0.0
    assert [side.lengths.sum() for side in slip.split(0.8)] == [8 * 200 - 10 - 21, 2 * 200]
    script.main([str(tmp_path / "noisy.csv"), "--quick", "--out", str(tmp_path)])
    assert "trained on the recording: -" in capsys.readouterr().out
    assert (tmp_path / "policy.py").exists()


def test_a_log_that_the_script_cannot_read_is_one_line(tmp_path):
    script = load(EXPERIMENTS / "from_a_log.py")
    pd.DataFrame({"commanded_left": [0.5]}).to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(SystemExit, match="error: .*has no column 'commanded_right'") as caught:
        script.main([str(tmp_path / "log.csv"), "--quick", "--out", str(tmp_path)])
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_one_agent_is_tested_under_structure_and_noise(tmp_path, capsys, monkeypatch):
    one = load(EXPERIMENTS / "one_agent.py")
    pendulum = sys.modules["pendulum"]
    best = pendulum.rtd.Ceiling(-136.0, 0.5, "exact")
    monkeypatch.setattr(pendulum.rtd, "ceiling", lambda env: best)
    monkeypatch.setattr(pendulum, "REFERENCE_EPISODES", 2)
    pendulum.scale.cache_clear()
    assert one.main(["--quick", "--agents", "lstm-td3-privileged", "--out", str(tmp_path)]) == 0
    rows = pd.read_parquet(tmp_path / "one_agent.parquet")
    assert set(rows["tested_on"]) == {"random-sine", "noise:sigma=1.0"}
    noisy = rows[rows["tested_on"].isin(one.NOISY)]
    # The filter's return is below the optimum, so a share of it is larger in size.
    assert (noisy["of_the_filter"].abs() > noisy["normalised"].abs()).all()
    assert rows["of_the_filter"].notna().sum() == len(noisy) == 1
    assert "the worst structured condition" in capsys.readouterr().out
    pendulum.scale.cache_clear()
