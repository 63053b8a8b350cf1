"""Sends learning curves to experiment trackers, between chunks.

A lane is a run of the tracker, with the name that it has in the run directory. The metrics over
environment steps are ``evaluation/return`` and metrics of learning, such as
``learning/critic_loss``. A lane that continues from a checkpoint continues its run. Environment
variables of the tracker (``WANDB_MODE``, ``MLFLOW_TRACKING_URI``) define where its data go; by
default they stay in the run directory. If a tracker cannot be opened, an error is raised before
training. If it fails later, it is removed with a warning, and training continues.
"""

import abc
import contextlib
import hashlib
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, Protocol, TypeVar

from rtd3jax.errors import UserError, short_reason
from rtd3jax.study.cells import Cell
from rtd3jax.study.lane_files import cell_name
from rtd3jax.study.rundir import RunDirectory

METRIC = "evaluation/return"
LEARNING = "learning/"
"""Prefix of the names of the metrics of learning."""


class Logger(Protocol):
    """Receives the rows of the log when they are written."""

    def log(self, cell: Cell, seed: int, row: dict[str, Any]) -> None:
        """Send ``row``: ``step``, ``return`` and ``metrics`` (None for infinity and NaN)."""

    def close(self) -> None:
        """Write all remaining data."""


Run = TypeVar("Run")
"""The type of a tracker's run: an object or an id."""


class PerLane(abc.ABC, Generic[Run]):
    """A logger with a run of the tracker for each lane, which begins at the lane's first row."""

    def __init__(self, directory: RunDirectory) -> None:
        self._path = directory.path
        self._study = directory.identity()
        self._runs: dict[tuple[str, int], Run] = {}

    def log(self, cell: Cell, seed: int, row: dict[str, Any]) -> None:
        """Send a point of the lane's curves."""
        lane = cell_name(cell), seed
        if lane not in self._runs:
            self._runs[lane] = self._begin(cell, seed)
        values = {METRIC: row["return"]}
        values |= {LEARNING + name: value for name, value in row["metrics"].items()}
        finite = {name: value for name, value in values.items() if value is not None}
        if finite:
            self._points(self._runs[lane], finite, row["step"])

    def close(self) -> None:
        """End all runs, even if the end of some fails."""
        with contextlib.ExitStack() as stack:
            for run in self._runs.values():
                stack.callback(self._end, run)

    @abc.abstractmethod
    def _begin(self, cell: Cell, seed: int) -> Run:
        """Begin or continue the run of a lane."""

    @abc.abstractmethod
    def _points(self, run: Run, values: dict[str, float], step: int) -> None:
        """Write values of metrics at a step."""

    @abc.abstractmethod
    def _end(self, run: Run) -> None:
        """End a run."""


class EventWriter(Protocol):
    """tensorboardX's ``SummaryWriter``."""

    def add_scalar(self, tag: str, value: float, step: int, /) -> object:
        """Write a point of a curve."""

    def flush(self) -> None:
        """Write all waiting points."""

    def close(self) -> None:
        """Write all waiting points, and close the files."""


class WandBRun(Protocol):
    """A run as ``wandb.init`` returns it."""

    def log(self, row: dict[str, float], /) -> object:
        """Write points of curves."""

    def finish(self) -> object:
        """End the run."""


class TensorBoard(PerLane[EventWriter]):
    """Event files in ``RUN/tensorboard/<cell>/seed-<n>``."""

    def __init__(self, directory: RunDirectory) -> None:
        super().__init__(directory)
        self._make = importlib.import_module("tensorboardX").SummaryWriter

    def _begin(self, cell: Cell, seed: int) -> EventWriter:
        path = self._path / "tensorboard" / cell_name(cell) / f"seed-{seed}"
        # If the writer thread has died, a full queue would block this thread. A row never fills it.
        return self._make(str(path), max_queue=1000)

    def _points(self, run: EventWriter, values: dict[str, float], step: int) -> None:
        for name, value in values.items():
            run.add_scalar(name, value, step)
        run.flush()  # raises an error of writing here, not only in the tracker's thread

    def _end(self, run: EventWriter) -> None:
        run.close()


class WandB(PerLane[WandBRun]):
    """A run of Weights & Biases for each lane; the project is named after the run directory."""

    def __init__(self, directory: RunDirectory) -> None:
        super().__init__(directory)
        self._wandb = importlib.import_module("wandb")
        self._mode = os.environ.get("WANDB_MODE", "offline")
        if self._mode == "online" and not self._wandb.api.api_key:
            raise UserError("WANDB_MODE is online, but there is no key; run wandb login")

    def _begin(self, cell: Cell, seed: int) -> WandBRun:
        name = cell_name(cell)
        run = self._wandb.init(
            project=os.environ.get("WANDB_PROJECT", self._path.resolve().name),
            id=_lane_id(self._study, name, seed),
            mode=self._mode,
            resume="allow",
            reinit="create_new",
            dir=str(self._path),
            group=name,
            name=f"{name} seed {seed}",
            config={**cell.to_dict(), "seed": seed},
        )
        for name in (METRIC, f"{LEARNING}*"):
            run.define_metric(name, step_metric="step")
        return run

    def _points(self, run: WandBRun, values: dict[str, float], step: int) -> None:
        run.log({**values, "step": step})

    def _end(self, run: WandBRun) -> None:
        run.finish()


class MLflow(PerLane[str]):
    """A run of MLflow for each lane, in the experiment named after the run directory."""

    def __init__(self, directory: RunDirectory) -> None:
        super().__init__(directory)
        mlflow = importlib.import_module("mlflow")
        store = f"sqlite:///{(directory.path / 'mlflow.db').resolve()}"
        self._client = mlflow.MlflowClient(os.environ.get("MLFLOW_TRACKING_URI", store))
        name = directory.path.resolve().name
        self._experiment = _experiment(self._client, name)

    def _begin(self, cell: Cell, seed: int) -> str:
        lane = _lane_id(self._study, cell_name(cell), seed)
        query = f"tags.lane = '{lane}'"
        for run in self._client.search_runs([self._experiment], query, max_results=1):
            return run.info.run_id
        name = f"{cell_name(cell)} seed {seed}"
        run = self._client.create_run(self._experiment, tags={"lane": lane}, run_name=name)
        for key, value in {**cell.to_dict(), "seed": seed}.items():
            self._client.log_param(run.info.run_id, key, value)
        return run.info.run_id

    def _points(self, run: str, values: dict[str, float], step: int) -> None:
        for name, value in values.items():
            self._client.log_metric(run, name, value, step=step)

    def _end(self, run: str) -> None:
        self._client.set_terminated(run)


LOGGERS: dict[str, tuple[str, Callable[[RunDirectory], Logger]]] = {
    "tensorboard": ("tensorboardX", TensorBoard),
    "wandb": ("wandb", WandB),
    "mlflow": ("mlflow", MLflow),
}
"""The trackers of ``--log``: the package of each, and the logger."""


class _Several:
    """Several loggers as one. A logger that fails is removed with a warning."""

    def __init__(self, loggers: dict[str, Logger]) -> None:
        self._loggers = loggers

    def log(self, cell: Cell, seed: int, row: dict[str, Any]) -> None:
        for name, logger in list(self._loggers.items()):
            try:
                logger.log(cell, seed, row)
            except Exception as error:
                del self._loggers[name]
                self._warn(name, error)
                with contextlib.suppress(Exception):  # its earlier rows may still be written
                    logger.close()

    def close(self) -> None:
        for name, logger in self._loggers.items():
            try:
                logger.close()
            except Exception as error:
                self._warn(name, error)

    @staticmethod
    def _warn(name: str, error: Exception) -> None:
        print(
            f"warning: --log {name} failed and gets no more rows; training continues: "
            f"{short_reason(error)}",
            file=sys.stderr,
        )


def check_loggers(names: Sequence[str]) -> None:
    """Check that the trackers are known and installed.

    Raises:
        UserError: naming the known trackers, or the extra that installs a missing one.
    """
    if isinstance(names, str):
        raise UserError(f"log must be a list of trackers, such as [{names!r}], not {names!r}")
    for name in names:
        if name not in LOGGERS:
            raise UserError(f"unknown tracker {name!r} (known: {', '.join(LOGGERS)})")
        package, _ = LOGGERS[name]
        if importlib.util.find_spec(package) is None:
            raise UserError(f"--log {name} needs {package}: pip install 'rtd3jax[{name}]'")


@contextlib.contextmanager
def open_loggers(names: Sequence[str], directory: RunDirectory) -> Iterator[Logger | None]:
    """The loggers of these names as one, which is closed at the end; None without names.

    Raises:
        UserError: when one of them cannot be opened.
    """
    if not names:
        yield None
        return
    loggers: dict[str, Logger] = {}
    for name in dict.fromkeys(names):
        try:
            loggers[name] = LOGGERS[name][1](directory)
        except Exception as error:
            raise UserError(f"--log {name} cannot be opened: {short_reason(error)}") from error
    logger = _Several(loggers)
    try:
        yield logger
    finally:
        logger.close()


def _experiment(client: Any, name: str) -> str:
    """The id of MLflow's experiment of this name, which is created if there is none."""
    if found := client.get_experiment_by_name(name):
        return found.experiment_id
    try:
        return client.create_experiment(name)
    except Exception:
        # Another shard may have created it since the look.
        if found := client.get_experiment_by_name(name):
            return found.experiment_id
        raise


def _lane_id(study: str, cell: str, seed: int) -> str:
    """The unique id of a lane, the same after each restart of its study."""
    text = f"{study}\n{cell}\n{seed}"
    # The path of the study may contain bytes that are not text.
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:24]
