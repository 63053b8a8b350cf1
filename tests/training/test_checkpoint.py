"""Tests bit-identical continuation from checkpoints, and messages about bad checkpoints."""

import dataclasses
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from gymnax.environments.classic_control.pendulum import Pendulum

import rtd3jax as rtd
from rtd3jax.system.files import read_arrays, write_arrays
from rtd3jax.training import checkpoint, lanes, train
from rtd3jax.training.checkpoint import Checkpoints
from rtd3jax.training.checkpoint_files import checkpoint_steps
from rtd3jax.training.grouping import with_common_steps
from rtd3jax.training.jobs import make_jobs
from rtd3jax.training.lane_identity import is_longer, same

CONFIG = rtd.Config(
    algorithm="h-td3",
    history_length=2,
    total_steps=120,
    hidden_size=4,
    batch_size=4,
    learning_starts=20,
    eval_every=40,
    eval_episodes=2,
    normalise_observations=True,  # so that its statistics are part of what goes on
)
SEEDS = [0, 1, 2]


def _env():
    return rtd.make("rover", disturbance="ar1-slip")


def _train(directory=None, config=CONFIG, env=None, **options):
    return rtd.train(
        env or _env(), config, SEEDS, progress=False, checkpoint_dir=directory, **options
    )


@pytest.fixture(scope="module")
def whole():
    return _train()


def _interrupt(directory, monkeypatch, **options):
    """Train with chunks of few steps, until an interrupt; checkpoints remain."""
    chunks = []

    def interrupt(_):
        chunks.append(1)
        if len(chunks) == 7:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(lanes, "_FIRST_CHUNK", 13)
        patch.setattr(lanes, "CHUNK_SECONDS", 0.0)
        patch.setattr(train.Progress, "update", lambda self, group: interrupt(group))
        with pytest.raises(KeyboardInterrupt):
            _train(directory, checkpoint_seconds=0.0, **options)
    files = list(directory.rglob("*.safetensors"))
    assert files and not any("000000120" in file.name for file in files)


@pytest.fixture
def stopped(tmp_path, monkeypatch):
    """A directory of checkpoints of a training that was interrupted."""
    _interrupt(tmp_path, monkeypatch)
    return tmp_path


def _assert_same(one, other):
    np.testing.assert_array_equal(one.returns, other.returns)
    for seed in SEEDS:
        leaves = map(jax.tree.leaves, (one.policy(seed), other.policy(seed)))
        for a, b in zip(*leaves, strict=True):
            np.testing.assert_array_equal(a, b)


def test_an_interrupted_training_goes_on_to_the_same_bits(stopped, whole):
    _assert_same(_train(stopped), whole)


@pytest.mark.parametrize(
    ("options", "changes"),
    [
        (dict(strategy="vmap"), {}),
        ({}, dict(replay="segments", segment_length=4, acting="carry")),
        ({}, dict(environments=4)),
        ({}, dict(algorithm="lstm-td3-privileged")),
    ],
)
def test_every_kind_of_training_goes_on_to_the_same_bits(tmp_path, monkeypatch, options, changes):
    """Episodes end before and after the interrupt."""
    options = dict(
        options,
        config=dataclasses.replace(CONFIG, **changes),
        env=rtd.make("pendulum", "random-sine", max_steps_in_episode=25),
    )
    _interrupt(tmp_path, monkeypatch, **options)
    _assert_same(_train(tmp_path, **options), _train(**options))


def test_a_finished_training_is_not_repeated(tmp_path, whole, monkeypatch):
    _train(tmp_path)
    monkeypatch.setattr(lanes, "_chunk", lambda *_: pytest.fail("trained again"))
    _assert_same(_train(tmp_path), whole)


def test_a_lane_that_has_ended_is_kept_while_others_train(tmp_path, monkeypatch):
    """As if the process were killed: nothing is written after the first lane has ended."""

    class Killed(BaseException):
        pass

    kept = []

    def update(self, group):
        kept.extend(tmp_path.rglob(f"step-{CONFIG.total_steps:09d}.safetensors"))
        if kept:
            monkeypatch.setattr(Checkpoints, "save", lambda *_: None)
            raise Killed

    longer = dataclasses.replace(CONFIG, total_steps=160)
    with monkeypatch.context() as patch:
        patch.setattr(train.Progress, "update", update)
        with pytest.raises(Killed):
            _train(tmp_path, [CONFIG, longer])
    assert not list(tmp_path.rglob("step-000000160.safetensors"))


def test_a_lane_that_has_ended_and_is_not_recorded_has_a_checkpoint(tmp_path, whole, monkeypatch):
    def interrupt(self, group):
        if group.finished:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(train.Progress, "update", interrupt)
        with pytest.raises(KeyboardInterrupt):
            _train(tmp_path)
    assert list(tmp_path.rglob(f"step-{CONFIG.total_steps:09d}.safetensors"))
    _assert_same(_train(tmp_path), whole)


def test_the_last_two_are_kept(stopped):
    assert all(len(list(d.glob("step-*"))) <= 2 for d in stopped.iterdir())
    assert any(len(list(d.glob("step-*"))) == 2 for d in stopped.iterdir())


def _newest(directory):
    lane = next(d for d in sorted(directory.iterdir()) if len(list(d.glob("step-*"))) == 2)
    return sorted(lane.glob("step-*"))


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty"])
def test_a_damaged_checkpoint_falls_back_to_the_older_one(stopped, whole, damage):
    newest = _newest(stopped)[-1]
    content = bytearray(newest.read_bytes())
    if damage == "truncated":
        content = content[: len(content) // 2]
    elif damage == "flipped":
        content[-50] ^= 1
    else:
        content = bytearray()
    newest.write_bytes(content)
    with pytest.warns(UserWarning, match="an older checkpoint is used"):
        _assert_same(_train(stopped), whole)


def test_no_silent_restart_when_every_checkpoint_is_damaged(stopped):
    for file in _newest(stopped):
        file.write_bytes(b"")
    with pytest.raises(rtd.UserError, match="there is no older checkpoint"):
        _train(stopped)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gamma": 0.5}, "gamma: 0.99 there, 0.5 here"),
        ({"algorithm": "lstm-td3"}, "algorithm: h-td3 there, lstm-td3 here"),
        ({"hidden_size": 8}, "hidden_size: 4 there, 8 here"),
    ],
)
def test_another_configuration_is_refused_with_the_difference(stopped, change, message):
    with pytest.raises(rtd.UserError, match=message):
        _train(stopped, dataclasses.replace(CONFIG, **change))


def test_refused_checkpoints_are_named_before_other_lanes_train(stopped, monkeypatch):
    monkeypatch.setattr(lanes, "compiled", lambda *_: pytest.fail("training began"))
    other = dataclasses.replace(CONFIG, gamma=0.5)
    newest = _newest(stopped)[-1]
    newest.write_bytes(b"")  # the older one of this lane is of another identity, too
    for strategy in ("map", "vmap"):
        with pytest.raises(rtd.UserError, match="gamma: 0.99 there, 0.5 here"):
            rtd.train(
                _env(), other, range(6), progress=False, checkpoint_dir=stopped, strategy=strategy
            )
    assert not (stopped / "seed-5").exists()
    # Only `restore` says that no file of a lane can be read.
    for file in newest.parent.iterdir():
        file.write_bytes(b"")
    (job,) = make_jobs(_env(), other, [int(newest.parent.name.removeprefix("seed-"))], cell=0)
    train._checkpoints([stopped], [other], _env(), None).check(job)


@pytest.mark.parametrize("kept", [False, True])
def test_an_error_ends_the_training_at_once_unless_checkpoints_keep_the_others(
    tmp_path, monkeypatch, kept
):
    steps = {}

    def chunk(group, *_):
        if group.jobs[0].seed == 1:
            raise RuntimeError("out of order")
        time.sleep(0.005)
        group.step += 1
        steps[group.jobs[0].seed] = group.step

    monkeypatch.setattr(lanes, "_chunk", chunk)
    with pytest.raises(RuntimeError, match="out of order"):
        _train(tmp_path if kept else None)
    ended = {seed for seed, step in steps.items() if step == CONFIG.total_steps}
    assert ended == ({0, 2} if kept else set())


def test_another_environment_or_version_is_refused(stopped, monkeypatch):
    with pytest.raises(rtd.UserError, match="another identity .params"):
        _train(stopped, env=rtd.make("rover", disturbance="ar1-slip-fast"))
    versions = checkpoint.versions()
    monkeypatch.setattr(checkpoint, "versions", lambda: {**versions, "jax": "9.9"})
    with pytest.raises(rtd.UserError, match="another versions .jax: .* there, 9.9 here"):
        _train(stopped)


class Weighted(Pendulum):
    """An environment without `rtd.ValueIdentity`, with an option."""

    def __init__(self, weights):
        super().__init__()
        self.weights = weights


@pytest.mark.parametrize(
    ("first", "second", "difference"),
    [
        (
            rtd.make("pendulum", disturbance="noise", reward_from="state"),
            rtd.make("pendulum", disturbance="noise", reward_from="observation"),
            "'state'.* there, .*'observation'.* here",
        ),
        (
            rtd.disturb(rtd.make("pendulum"), rtd.Hidden(element=2)),
            rtd.disturb(rtd.make("pendulum"), rtd.Hidden(element=0)),
            "element=2.* there, .*element=0.* here",
        ),
        (
            Weighted((1.0, 2.0)),
            Weighted((5.0, 6.0)),
            "1.0, 2.0.* there, .*5.0, 6.0.* here",
        ),
    ],
)
def test_static_options_of_an_environment_identify_a_lane(first, second, difference, tmp_path):
    config = dataclasses.replace(CONFIG, total_steps=30, algorithm="td3", history_length=None)

    def write(env):
        checkpoints = train._checkpoints([tmp_path], [config], env, None)
        (job,) = make_jobs(env, config, [0], cell=0)
        return checkpoints, job, job.program.init(job.lane)

    checkpoints, job, state = write(first)
    checkpoints.save_lane(job, state, 10)
    assert checkpoints.restore([job]) is not None
    checkpoints, job, _ = write(second)
    with pytest.raises(rtd.UserError, match=f"another identity .plant: .*{difference}"):
        checkpoints.restore([job])
    # A checkpoint of an earlier version does not have it.
    file = next(tmp_path.rglob("*.safetensors"))
    arrays, metadata = read_arrays(file)
    del metadata["identity"]["plant"]
    write_arrays(file, arrays, metadata)
    assert checkpoints.restore([job]) is not None


def test_a_directory_that_cannot_be_written_is_named_before_the_training(tmp_path, monkeypatch):
    monkeypatch.setattr(lanes, "compiled", lambda *_: pytest.fail("training began"))
    (tmp_path / "file").write_text("")
    with pytest.raises(rtd.UserError, match="cannot be written: Not a directory$"):
        _train(tmp_path / "file")
    (tmp_path / "seed-1").write_text("")
    with pytest.raises(rtd.UserError, match="seed-1 cannot be written: File exists$"):
        _train(tmp_path)


def test_a_lane_that_cannot_be_written_does_not_stop_the_others(tmp_path, monkeypatch):
    def interrupt(_, group):
        monkeypatch.setattr(checkpoint, "write_arrays", write_others)
        raise KeyboardInterrupt

    def write_others(file, *rest):
        if file.parent.name == "seed-0":
            raise OSError(28, "No space left on device")
        write_arrays(file, *rest)

    monkeypatch.setattr(lanes, "_FIRST_CHUNK", 13)
    monkeypatch.setattr(train.Progress, "update", interrupt)
    # As under vmap, in one group; under map, each lane is a group of its own.
    for strategy in ("map", "vmap"):
        with pytest.raises(rtd.UserError, match="seed-0 cannot be written: No space left"):
            _train(tmp_path / strategy, strategy=strategy)
        saved = {file.parent.name for file in (tmp_path / strategy).rglob("*.safetensors")}
        assert "seed-0" not in saved and ("seed-2" in saved or strategy == "map")
        assert "seed-1" in saved


@pytest.mark.parametrize("strategy", ["map", "vmap"])
def test_a_disk_that_is_full_for_a_moment_does_not_end_the_training(
    strategy, tmp_path, whole, monkeypatch
):
    failures = []

    def fail_twice(file, *rest):
        if len(failures) < 2:
            failures.append(file)
            raise OSError(28, "No space left on device")
        write_arrays(file, *rest)

    monkeypatch.setattr(checkpoint, "write_arrays", fail_twice)
    monkeypatch.setattr(lanes, "_FIRST_CHUNK", 13)
    monkeypatch.setattr(lanes, "CHUNK_SECONDS", 0.0)
    with pytest.warns(UserWarning, match="No space left on device; the training continues"):
        result = _train(tmp_path, checkpoint_seconds=0.0, strategy=strategy)
    assert len(failures) == 2
    assert np.isfinite(result.returns).all()
    if strategy == "map":
        _assert_same(result, whole)
    for seed in SEEDS:  # those of the end could be written
        assert checkpoint_steps(tmp_path / f"seed-{seed}")[0] == CONFIG.total_steps


@pytest.mark.parametrize("strategy", ["map", "vmap"])
def test_a_disk_that_stays_full_costs_no_result(strategy, tmp_path, whole, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "write_arrays", fail)
    with pytest.warns(UserWarning, match="No space left on device; the result is kept in memory"):
        result = _train(tmp_path, strategy=strategy)
    assert np.isfinite(result.returns).all()
    if strategy == "map":
        _assert_same(result, whole)


def test_a_checkpoint_of_one_lane_is_not_one_of_its_group(tmp_path):
    """Else an interrupt after it would lose the last steps of the other lanes."""
    checkpoints = Checkpoints(lambda job: tmp_path / job, lambda job: {})
    state = {"leaf": np.zeros(1)}
    group = SimpleNamespace(step=7, lanes=lambda: [("a", state), ("b", state)])
    checkpoints.save_lane("a", state, 7, kept=1)
    checkpoints.save_once(group)
    assert checkpoint_steps(tmp_path / "a") == checkpoint_steps(tmp_path / "b") == [7]


def test_files_of_later_steps_do_not_outlive_a_lane_that_started_over(tmp_path):
    """Its new checkpoints would be the oldest, and be removed as soon as they are written."""
    checkpoints = Checkpoints(lambda job: tmp_path, lambda job: {})
    for step in (1_637, 2_000, 600, 700, 800):
        checkpoints.save_lane(None, {"leaf": np.zeros(1)}, step)
        newest = checkpoint_steps(tmp_path)
        assert newest[0] == step and len(newest) <= 2
    assert newest == [800, 700]


def test_lanes_that_were_torn_apart_advance_together_from_a_common_step():
    steps = {"a": {224, 284}, "b": {224, 284}, "c": {224}, "d": {224}, "new": set()}
    steps |= {"e": {5_000, 6_000}, "f": {7_000}, "other": set()}
    parts = with_common_steps(list(steps), list(steps.values()))
    assert parts == [["a", "b", "c", "d"], ["f"], ["e"], ["new", "other"]]
    assert with_common_steps([], []) == []
    assert with_common_steps(["a", "b"], [set(), set()]) == [["a", "b"]]


def test_nan_in_an_identity_is_the_same_nan():
    nan = {"params": [7, float("nan")]}
    assert same(nan, {"params": [7, float("nan")]})
    assert not same(nan, {"params": [7, 0.0]})
    longer = {**nan, "total_steps": 40}
    assert is_longer({"params": [7, float("nan")], "total_steps": 20}, longer)


def test_typed_keys_survive(tmp_path):
    from rtd3jax.training.checkpoint_arrays import _from_array, _to_array

    key = jax.random.key(3)
    leaf = jax.eval_shape(lambda: key)
    back = _from_array(_to_array(key), leaf, "key", tmp_path)
    assert back.dtype == key.dtype
    np.testing.assert_array_equal(jax.random.bits(back), jax.random.bits(key))


def test_large_checkpoints_wait_longer_by_default(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(checkpoint.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(checkpoint, "cores", lambda: 2)

    def lane():
        states = [(None, {"leaf": np.zeros(1)})]
        return SimpleNamespace(step=1, lanes=lambda: states, finished=False)

    def slow_write(*_):
        now[0] += 6.0

    monkeypatch.setattr(checkpoint, "write_arrays", slow_write)
    # Of 40 lanes, each may take 2% of a twentieth of the time of a core.
    for seconds, others, wait in ((None, 0, 900.0), (60.0, 0, 60.0), (None, 39, 6_000.0)):
        checkpoints = Checkpoints(lambda job: tmp_path, lambda job: {}, seconds)
        group, *more = [lane() for _ in range(1 + others)]
        assert not any(checkpoints.is_due(one) for one in (group, *more))
        checkpoints.save(group)
        now[0] += wait - 1.0
        assert not checkpoints.is_due(group)
        now[0] += 1.0
        assert checkpoints.is_due(group)
