"""Tests additions to a study: existing files do not change, other changes are refused."""

import json
import os
import threading

import jax
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax import sweep
from rtd3jax.study import finish, rundir, time_estimate
from rtd3jax.study.cells import Cell, cell_jobs
from rtd3jax.study.contents import Contents
from rtd3jax.study.lane_files import cell_name
from rtd3jax.study.lock import writer
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import write_bytes_atomically
from rtd3jax.training import checkpoint

SETTINGS = dict(hidden_size=4, batch_size=4, learning_starts=10, eval_every=30, eval_episodes=1)
FLAGS = [f"--{name.replace('_', '-')}={value}" for name, value in SETTINGS.items()]
SETTINGS["normalise_observations"] = True
COMMAND = [
    *("--env", "rover", "--disturbances", "ar1-slip", "--history-lengths", "2"),
    *("--final-episodes", "2", "--quiet", "--no-report", "--keep-checkpoints"),
    *("--normalise-observations", *FLAGS),
]
TABLES = "curves.parquet", "episodes.parquet", "metrics.parquet", "summary.md"


@pytest.fixture(autouse=True, scope="module")
def quick():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finish, "refresh_page", lambda *_, **__: None)
        yield


def run(out, algorithms, seeds, steps, *more):
    found = [*COMMAND, "--out", str(out), "--algorithms", *algorithms.split()]
    return sweep.main([*found, "--seeds", str(seeds), "--total-steps", str(steps), *more])


def contents(out):
    files = [out / name for name in TABLES] + sorted(out.glob("lanes/**/*.safetensors"))
    return {str(file.relative_to(out)): file.read_bytes() for file in files}


def cell(algorithm="td3", **changes):
    length = None if algorithm == "td3" else 2
    config = dict(algorithm=algorithm, history_length=length, total_steps=60)
    return Cell("rover", "ar1-slip", rtd.Config(**{**config, **SETTINGS, **changes}))


@pytest.fixture(scope="module")
def grown(tmp_path_factory):
    """A directory after each growth: what it held, and what was said."""
    out = tmp_path_factory.mktemp("grown") / "run"
    kept = {}
    for name, asked in {
        "begun": ("h-td3", 1, 60),
        "wider": ("td3", 2, 60),
        "longer": ("h-td3", 2, 120),
    }.items():
        assert run(out, *asked) == 0
        kept[name] = contents(out), json.loads((out / "config.json").read_text())
    return out, kept


def test_a_study_that_grew_is_the_study_that_was_asked_for_at_once(grown, tmp_path):
    _, kept = grown
    assert run(tmp_path / "run", "h-td3 td3", 2, 60) == 0
    assert contents(tmp_path / "run") == kept["wider"][0]
    lane = "lanes/rover_ar1-slip_h-td3_l2/seed-0.safetensors"
    assert kept["begun"][0][lane] == kept["wider"][0][lane]


def test_more_steps_are_the_longer_training_to_the_bit(grown, tmp_path):
    _, kept = grown
    assert run(tmp_path / "run", "h-td3", 2, 120) == 0
    at_once = {name: file for name, file in contents(tmp_path / "run").items() if "lanes" in name}
    assert len(at_once) == 2 and at_once.items() <= kept["longer"][0].items()
    study, grown_by = kept["longer"][1]["study"], kept["longer"][1]["grown"]
    assert [cell["total_steps"] for cell in study["cells"]] == [120, 60]
    assert study["seeds"] == [0, 1] and study["stages"] == [1]
    assert [entry["added"] for entry in grown_by] == [
        "seed 1, 1 cell (rover ar1-slip td3)",
        "120 steps for 60 of rover ar1-slip h-td3 l=2",
    ]


def test_a_training_goes_on_with_more_steps_and_more_seeds(grown, tmp_path):
    out, _ = grown
    env = rtd.make("rover", disturbance="ar1-slip")
    for seeds, steps in (([0], 60), ([0, 1], 120)):
        config = cell("h-td3", total_steps=steps).config
        training = rtd.train(env, config, seeds, progress=False, checkpoint_dir=tmp_path)
    directory = RunDirectory.open(out)
    for seed in (0, 1):
        policies = training.policy(seed), directory.lanes.policy(directory.cells[0], seed)
        for one, other in zip(*(jax.tree.leaves(p) for p in policies), strict=True):
            np.testing.assert_array_equal(one, other)
    shorter = cell("h-td3", total_steps=90).config
    with pytest.raises(rtd.UserError, match="total_steps: 120 there, 90 here"):
        rtd.train(env, shorter, [0], progress=False, checkpoint_dir=tmp_path)


def test_what_is_there_already_is_not_trained_again(grown, capsys, monkeypatch):
    from rtd3jax.training import lanes

    out, kept = grown
    monkeypatch.setattr(lanes, "_chunk", lambda *_: pytest.fail("trained again"))
    assert run(out, "h-td3", 1, 120) == 0
    assert "holds more cells or seeds than this command names: all of its 2 cells × 2 seeds" in (
        capsys.readouterr().out
    )
    assert contents(out) == kept["longer"][0]


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (("h-td3", 3, 120, "--gamma", "0.9"), "holds another study (gamma: 0.99 there, 0.9 here)"),
        (("h-td3", 3, 60), "total_steps: 120 there, 60 here"),
        (("h-td3", 3, 120, "--final-episodes", "3"), "final_episodes: 2 there, 3 here"),
    ],
)
def test_what_would_change_a_finished_lane_is_refused_and_named(grown, asked, message, capsys):
    out, kept = grown
    assert run(out, *asked) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert contents(out) == kept["longer"][0]
    assert json.loads((out / "config.json").read_text()) == kept["longer"][1]


def test_a_dry_run_says_what_would_be_added_and_writes_nothing(grown, capsys, monkeypatch):
    out, kept = grown
    monkeypatch.setattr(time_estimate, "group_seconds", lambda jobs: 1.0)
    assert run(out, "lstm-td3", 3, 120, "--dry-run", "--gamma", "0.5") == 0
    text = capsys.readouterr().out
    assert "3 cells × 3 seeds = 9 lanes" in text
    assert "seed 2, 1 cell (rover ar1-slip lstm-td3 l=2; gamma 0.5, before 0.99)" in text
    assert json.loads((out / "config.json").read_text()) == kept["longer"][1]


def _directory(path, *cells, seeds=(0,)):
    return RunDirectory.create(path, cells or [cell()], seeds, 2)


def _finish(directory, one, failure=None, checkpoint=None):
    """Write what a lane of seed 0 leaves, without training it."""
    directory.lanes.write_lane(one, 0, {}, {}, {}, failure)
    if checkpoint is not None:
        kept = directory.lanes.checkpoint_directory(one, 0)
        kept.mkdir(parents=True)
        (kept / f"step-{checkpoint:09d}.safetensors").write_text("")


def test_more_steps_that_cannot_go_on_are_refused_with_what_to_do(tmp_path):
    directory = _directory(tmp_path / "a")
    _finish(directory, cell())
    with pytest.raises(rtd.UserError, match="1 of its lanes ended at 60 without a checkpoint"):
        _directory(tmp_path / "a", cell(total_steps=90))
    directory.lanes.lane_path(cell(), 0).unlink()  # as the message says
    _directory(tmp_path / "a", cell(total_steps=90))

    falling = cell(final_learning_rate_fraction=0.0)
    _finish(_directory(tmp_path / "b", falling), falling, checkpoint=60)
    longer = cell(final_learning_rate_fraction=0.0, total_steps=90)
    with pytest.raises(rtd.UserError, match="falling towards step 60 .final_learning_rate_fr"):
        _directory(tmp_path / "b", longer)

    odd = cell(eval_every=40)
    _finish(_directory(tmp_path / "c", odd), odd, checkpoint=60)
    with pytest.raises(rtd.UserError, match="step 60, is not a multiple of eval_every"):
        _directory(tmp_path / "c", cell(eval_every=40, total_steps=90))

    lost = {"step": 7, "reason": "it was lost"}
    _finish(_directory(tmp_path / "d"), cell(), failure=lost)
    later = _directory(tmp_path / "d", cell(total_steps=90))
    assert later.lanes.is_done(cell(total_steps=90), 0)  # it would be lost again


def test_lanes_whose_checkpoints_are_of_no_use_stay_in_a_study_that_was_not_extended(
    tmp_path, monkeypatch, capsys
):
    """If it was, the ended lanes would leave the tables, and could never go on."""
    out = tmp_path / "run"
    assert run(out, "td3", 1, 60) == 0
    before, config = contents(out), (out / "config.json").read_bytes()
    (kept,) = out.glob("checkpoints/*/seed-0/*.safetensors")
    whole = kept.read_bytes()

    def is_refused(message):
        assert run(out, "td3", 1, 120) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and message in error
        assert "td3 seed 0 cannot continue to 120 steps" in error
        assert contents(out) == before and (out / "config.json").read_bytes() == config
        study = rtd.Study(RunDirectory.open(out).cells, seeds=[0], out=out, final_episodes=2)
        assert study.policy(study._directory.cells[0], 0).algorithm == "td3"

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "versions", lambda: {"rtd3jax": "9.9.9"})
        is_refused("belongs to another versions")
    kept.write_bytes(whole[:-1])
    is_refused("there is no older checkpoint")
    kept.write_bytes(whole)
    assert run(out, "td3", 1, 120) == 0


def test_a_default_that_is_given_adds_nothing(tmp_path):
    there = RunDirectory.create(tmp_path / "run", [cell()], [0], 2)
    asked = cell(actor_starts=SETTINGS["learning_starts"])
    again = RunDirectory(tmp_path / "run", [asked], [0], 2)
    assert again.plan() == "" and again.cells == there.cells == [cell()]


def test_looking_at_a_study_does_not_let_it_grow(tmp_path):
    _directory(tmp_path)
    before = (tmp_path / "config.json").read_bytes()
    study = rtd.Study([cell(), cell("h-td3")], seeds=range(3), out=tmp_path, final_episodes=2)
    assert len(study.status()) == 6 and (tmp_path / "config.json").read_bytes() == before


def test_a_study_grows_only_while_no_one_writes_to_it(tmp_path, monkeypatch):
    _directory(tmp_path)
    before = (tmp_path / "config.json").read_bytes()
    monkeypatch.setattr(rundir, "_PATIENCE", 0)
    with writer(tmp_path, (1, 2)):
        _directory(tmp_path)  # the same study may go on
        with pytest.raises(rtd.UserError, match="another process is writing to it"):
            _directory(tmp_path, seeds=(0, 1))
        assert (tmp_path / "config.json").read_bytes() == before
        # Of two shards of one command the second finds that the first let it grow.
        content = json.loads(before)
        content["study"]["seeds"] = [0, 1]
        monkeypatch.setattr(rundir, "_PATIENCE", 10)
        grown = tmp_path / "config.json", json.dumps(content).encode()
        thread = threading.Timer(0.2, write_bytes_atomically, grown)
        thread.start()
        assert _directory(tmp_path, seeds=(0, 1)).seeds == [0, 1]
        thread.join()


def test_what_another_process_added_is_seen(tmp_path):
    mine = _directory(tmp_path)
    _directory(tmp_path, cell("h-td3"), seeds=(1,))
    assert mine.refresh() and mine.seeds == [0, 1] and len(mine.cells) == 2
    assert not mine.refresh()


def test_killed_while_it_grows_the_study_is_the_old_one(tmp_path, monkeypatch):
    _directory(tmp_path)

    def die(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", die)
        with pytest.raises(KeyboardInterrupt):
            _directory(tmp_path, cell("h-td3"), seeds=(0, 1))
    assert RunDirectory.open(tmp_path).contents == Contents((cell(),), (0,), 2)
    _directory(tmp_path, cell("h-td3"), seeds=(0, 1))
    assert RunDirectory.open(tmp_path).contents.stages == (1,)


def test_a_longer_window_that_comes_later_changes_no_program_side_by_side(tmp_path):
    short, longer = cell("h-td3"), cell("h-td3", history_length=5)
    alone = {job.key: job.program for job in cell_jobs([short], [0], "vmap")}
    _directory(tmp_path, short)
    _directory(tmp_path, longer)
    later = {job.key: job.program for job in RunDirectory.open(tmp_path).jobs("vmap")}
    assert later[short, 0] == alone[short, 0] and later[short, 0].window_tokens == 2
    assert later[longer, 0].window_tokens == 5
    at_once = {job.key: job.program for job in cell_jobs([short, longer], [0], "vmap")}
    assert at_once[short, 0].window_tokens == 5
    assert cell_name(short) != cell_name(longer)
