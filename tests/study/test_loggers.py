"""Tests that each tracker gets every evaluation of every lane, without a network."""

import struct
import types

import pytest

import rtd3jax as rtd
from rtd3jax.cli import sweep
from rtd3jax.errors import UserError
from rtd3jax.study import loggers, run
from rtd3jax.study.cells import Grid, make_cells
from rtd3jax.study.loggers import METRIC, check_loggers, open_loggers
from rtd3jax.study.rundir import RunDirectory

LOSS = "learning/critic_loss"
ROWS = [(20, -3.5), (40, None), (60, -1.25)]


@pytest.fixture
def directory(tmp_path):
    cells = make_cells([Grid("rover", ("ar1-slip",), ("td3", "h-td3"), (1,))], {})
    return RunDirectory.create(tmp_path / "run", cells, [0, 1], 2)


def feed(name, directory, rows=ROWS):
    with open_loggers([name], directory) as logger:
        for cell in directory.cells:
            for seed in directory.seeds:
                for step, value in rows:
                    metrics = {"critic_loss": None if value is None else -2 * value}
                    logger.log(cell, seed, {"step": step, "return": value, "metrics": metrics})


def test_tensorboard(directory):
    pytest.importorskip("tensorboardX")
    from tensorboardX.proto.event_pb2 import Event

    feed("tensorboard", directory)
    files = sorted((directory.path / "tensorboard").glob("*/seed-*/events*"))
    assert len(files) == 4
    for file in files:
        data, points = file.read_bytes(), []
        while data:  # records: length, its checksum, an event, its checksum
            (length,) = struct.unpack("<Q", data[:8])
            event = Event.FromString(data[12 : 12 + length])
            points += [(event.step, v.tag, v.simple_value) for v in event.summary.value]
            data = data[16 + length :]
        expected = [(20, METRIC, -3.5), (20, LOSS, 7.0), (60, METRIC, -1.25), (60, LOSS, 2.5)]
        assert points == expected


def test_mlflow_goes_on_in_the_run_of_a_lane(directory):
    pytest.importorskip("mlflow")
    from mlflow import MlflowClient

    feed("mlflow", directory, ROWS[:1])
    feed("mlflow", directory, ROWS[1:])
    client = MlflowClient(f"sqlite:///{directory.path / 'mlflow.db'}")
    runs = client.search_runs([client.get_experiment_by_name("run").experiment_id])
    assert len(runs) == 4
    for one in runs:
        points = client.get_metric_history(one.info.run_id, METRIC)
        assert [(p.step, p.value) for p in points] == [(20, -3.5), (60, -1.25)]
        losses = client.get_metric_history(one.info.run_id, LOSS)
        assert [(p.step, p.value) for p in losses] == [(20, 7.0), (60, 2.5)]
        assert one.data.params["env"] == "rover"


class FakeMlflow:
    """A store in which another shard creates the experiment at the same moment."""

    def __init__(self, reason):
        self.found, self.reason = None, reason

    def MlflowClient(self, store):  # noqa: N802
        return self

    def get_experiment_by_name(self, name):
        return self.found

    def create_experiment(self, name):
        if self.reason == "already exists":
            self.found = types.SimpleNamespace(experiment_id="7")
        raise OSError(self.reason)


def test_shards_that_create_the_same_experiment_share_it(directory, monkeypatch):
    fake = FakeMlflow("already exists")
    monkeypatch.setattr(loggers.importlib, "import_module", lambda name: fake)
    assert loggers.MLflow(directory)._experiment == "7"
    fake = FakeMlflow("no space")
    with pytest.raises(OSError, match="no space"):
        loggers.MLflow(directory)


def test_wandb_offline(directory, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    feed("wandb", directory)
    files = list((directory.path / "wandb").glob("offline-run-*/*.wandb"))
    assert len(files) == 4
    for file in files:
        content = file.read_bytes()
        assert METRIC.encode() in content and b"-1.25" in content


def test_a_sweep_feeds_them(tmp_path, monkeypatch):
    rows = []

    class Fake:
        def __init__(self, directory):
            pass

        def log(self, cell, seed, row):
            assert row["metrics"]["critic_loss"] > 0
            rows.append((cell.config.algorithm, seed, row["step"]))

        def close(self):
            rows.append("closed")

    monkeypatch.setitem(loggers.LOGGERS, "tensorboard", ("json", Fake))
    monkeypatch.setattr(run, "references_of", lambda cells: [])
    study = "--env rover --disturbances ar1-slip --algorithms td3 --seeds 2 --total-steps 60 "
    study += "--hidden-size 4 --batch-size 4 --learning-starts 10 --eval-every 30 "
    study += "--eval-episodes 1 --final-episodes 2 --quiet --no-report"
    command = [*study.split(), "--out", str(tmp_path / "run"), "--log", "tensorboard"]
    assert sweep.main(command) == 0
    assert rows.pop() == "closed"
    assert sorted(rows) == [("td3", s, step) for s in (0, 1) for step in (30, 60)]


def test_what_is_not_installed_is_named(monkeypatch):
    monkeypatch.setitem(loggers.LOGGERS, "wandb", ("no_such_package", None))
    with pytest.raises(UserError, match=r"pip install 'rtd3jax\[wandb\]'"):
        check_loggers(["wandb"])


@pytest.mark.parametrize(
    ("names", "message"),
    [(["csv"], "unknown tracker 'csv'"), ("tensorboard", "must be a list of trackers")],
)
def test_a_study_refuses_an_unknown_tracker_and_a_name_that_is_no_list(tmp_path, names, message):
    cell = rtd.Cell("rover", "none", rtd.Config("td3"))
    with pytest.raises(UserError, match=message):
        rtd.Study([cell], seeds=[0], out=tmp_path / "run").run(log=names)


class Failing:
    """Fails in the methods that are named."""

    def __init__(self, *fails):
        self.fails, self.calls = fails, []

    def log(self, cell, seed, row):
        self._call("log")

    def close(self):
        self._call("close")

    def _call(self, name):
        self.calls.append(name)
        if name in self.fails:
            raise OSError("No space left on device\nand more")


def test_a_tracker_that_fails_is_one_warning_and_the_rest_go_on(directory, monkeypatch, capsys):
    fakes = {"tensorboard": Failing("log", "close"), "wandb": Failing("close"), "mlflow": Failing()}
    for name, fake in fakes.items():
        monkeypatch.setitem(loggers.LOGGERS, name, ("json", lambda directory, fake=fake: fake))
    with open_loggers(list(fakes), directory) as logger:
        for _ in range(3):
            logger.log(directory.cells[0], 0, {})
    assert fakes["tensorboard"].calls == ["log", "close"]
    assert fakes["wandb"].calls == fakes["mlflow"].calls == ["log"] * 3 + ["close"]
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(" failed")[0] for line in lines] == [
        "warning: --log tensorboard",
        "warning: --log wandb",
    ]
    assert all(line.endswith("No space left on device") for line in lines)


def test_a_tracker_that_cannot_be_opened_is_refused(directory, monkeypatch):
    def refuse(directory):
        raise OSError("no such host\nand more")

    monkeypatch.setitem(loggers.LOGGERS, "mlflow", ("json", refuse))
    with (
        pytest.raises(UserError, match="--log mlflow cannot be opened: no such host$"),
        open_loggers(["mlflow"], directory),
    ):
        pass


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_tensorboard_on_a_full_disk_neither_stops_nor_hangs(directory, monkeypatch, capsys):
    writers = pytest.importorskip("tensorboardX.event_file_writer")

    def refuse(self):
        raise OSError("No space left on device")

    monkeypatch.setattr(writers.EventsWriter, "flush", refuse)
    feed("tensorboard", directory, ROWS * 10)
    lines = capsys.readouterr().err.splitlines()
    assert sum(line.startswith("warning: --log tensorboard failed") for line in lines) == 1


class FakeWandb:
    """Keeps what ``init`` and ``log`` were given."""

    class api:  # noqa: N801
        api_key = None

    def __init__(self):
        self.begun, self.rows, self.axes = [], [], {}

    def init(self, **arguments):
        self.begun.append(arguments)
        return self

    def define_metric(self, name, step_metric):
        self.axes[name] = step_metric

    def log(self, values):
        self.rows.append(values)

    def finish(self):
        pass


def test_wandb_is_offline_unless_asked(directory, monkeypatch):
    fake, row = FakeWandb(), {"step": 1, "return": 1.5, "metrics": {"critic_loss": 0.5}}
    monkeypatch.setattr(loggers.importlib, "import_module", lambda name: fake)
    for mode in (None, "disabled"):
        monkeypatch.delenv("WANDB_MODE", raising=False)
        if mode:
            monkeypatch.setenv("WANDB_MODE", mode)
        with open_loggers(["wandb"], directory) as logger:
            logger.log(directory.cells[0], 0, row)
        assert fake.begun[-1]["mode"] == (mode or "offline")
        assert fake.rows[-1] == {METRIC: 1.5, LOSS: 0.5, fake.axes[METRIC]: 1}
    first, again = fake.begun
    assert first["id"] == again["id"] and again["resume"] == "allow"  # one curve, when resumed
    monkeypatch.setenv("WANDB_MODE", "online")
    with pytest.raises(UserError, match="run wandb login"), open_loggers(["wandb"], directory):
        pass


def test_a_study_that_begins_anew_in_the_same_place_has_new_ids(directory):
    first = directory.identity()
    assert RunDirectory.open(directory.path).identity() == first
    (directory.path / "config.json").unlink()
    anew = RunDirectory.create(directory.path, directory.cells, [0, 1], 2)
    assert anew.identity() != first
    assert anew.identity().endswith(str(directory.path.resolve()))
