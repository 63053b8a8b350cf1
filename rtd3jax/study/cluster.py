"""The cells of a sweep as tasks of a Ray cluster.

Ray schedules the tasks, monitors its nodes, and restarts a task when its worker or node dies. The
run directory is on shared storage, so a restarted task continues from the checkpoints of its lanes.
The driver holds the lock of the directory, monitors the tasks, and writes the tables.
"""

import contextlib
import dataclasses
import importlib
import itertools
import json
import math
import os
import platform
import socket
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from rtd3jax.errors import UserError, short_reason
from rtd3jax.study.cells import Cell
from rtd3jax.study.derive import Reference
from rtd3jax.study.execute import Work, forget_errors, train_here, waiting_jobs
from rtd3jax.study.interim import InterimResults
from rtd3jax.study.lane_files import cell_name
from rtd3jax.study.log import TASKS
from rtd3jax.study.log_reader import LogReader
from rtd3jax.study.loggers import Logger
from rtd3jax.study.memory_plan import WORKER_BYTES, job_bytes, lanes_at_once, usable_memory
from rtd3jax.study.rundir import PACKAGES, RunDirectory
from rtd3jax.system.files import user_path
from rtd3jax.system.imports import import_modules
from rtd3jax.system.interrupts import patient
from rtd3jax.system.versions import versions_of
from rtd3jax.training.checkpoint_files import checkpoint_steps
from rtd3jax.training.devices import workers
from rtd3jax.training.jobs import Job

_POLL_SECONDS = 0.1
_CONNECT_SECONDS = 10.0
_ENDING_SECONDS = 60.0
_ENDING = (
    "the tasks end their current steps and write checkpoints; another interrupt ends them without "
    "these"
)


@dataclasses.dataclass(frozen=True)
class Need:
    """The resources that a task needs; ``memory`` is in bytes."""

    cpus: int
    gpus: int
    memory: int


def train_on_cluster(
    directory: RunDirectory,
    jobs: Sequence[Job],
    work: Work,
    complaints: list[str],
    references: Sequence[Reference],
    logger: Logger | None,
    address: str,
    imports: Sequence[str],
) -> None:
    """Train the lanes that have not ended, with a Ray task for each cell.

    Args:
        directory: the run directory, on storage that has the same path on every node.
        jobs: all lanes of the run.
        work: options of the training.
        complaints: list to which a line is added for each lane or cell that fails.
        references: policies without training, for the interim tables.
        logger: the trackers, to which this process sends rows.
        address: the address of the cluster, or ``auto``.
        imports: modules that register environments.

    Raises:
        UserError: when Ray is not installed, there is no cluster, no node has the resources, or a
            node has other versions or cannot read the run directory.
    """
    waiting: dict[Cell, list[Job]] = {}
    for job in waiting_jobs(directory, jobs):
        waiting.setdefault(job.cell, []).append(job)
    if not waiting:
        return
    ray = _ray()
    with _connected(ray, address):
        needs = {cell: _need(members, work, _alive(ray)) for cell, members in waiting.items()}
        _check_nodes(ray, _alive(ray), directory, imports)
        forget_errors(directory, itertools.chain.from_iterable(waiting.values()))
        task = ray.remote(_train_cell)
        pending = {}
        for cell, members in waiting.items():
            seeds, need = [job.seed for job in members], needs[cell]
            options = {
                "num_cpus": need.cpus,
                "num_gpus": need.gpus,
                "memory": need.memory,
                "max_retries": -1,  # Ray repeats a task if its worker dies, not after an error
                "name": cell.words,
            }
            path = str(directory.path.resolve())
            index = directory.cells.index(cell)
            arguments = (path, index, seeds, dataclasses.replace(work, quiet=True), need.cpus)
            pending[task.options(**options).remote(*arguments, list(imports))] = members
        interim = InterimResults(directory, references, page=work.page)
        log = LogReader(directory, logger)
        _watch(ray, directory, pending, complaints, interim, log, work.quiet)


def check_absolute_starts(cells: Iterable[Cell]) -> None:
    """Raise UserError if the start of a cell is a relative path: a node has another directory."""
    for cell in cells:
        start = cell.config.start
        if start and not user_path(start).is_absolute():
            raise UserError(
                f"--start {start} is relative to the directory of this process, which the nodes of "
                "a cluster do not have: give the absolute path, on the shared storage"
            )


def _alive(ray: ModuleType) -> list[dict]:
    return [node for node in ray.nodes() if node["Alive"]]


def _ray() -> Any:
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise UserError("--cluster needs Ray: pip install 'rtd3jax[ray]'") from error


@contextlib.contextmanager
def _connected(ray: ModuleType, address: str) -> Iterator[None]:
    # Ray hides from a task the GPUs that it does not request. With this variable, Ray does not hide
    # all GPUs from a task that requests none.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        _check_listening(address)
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (OSError, ValueError, OverflowError, RuntimeError) as error:
        reason = short_reason(error)
        raise UserError(
            f"--cluster {address}: there is no Ray cluster ({reason}); start one with "
            "ray start --head"
        ) from error
    try:
        yield
    finally:
        ray.shutdown()


def _check_listening(address: str) -> None:
    """Raise an error at once if nothing listens at ``address``: Ray would retry for minutes."""
    host, colon, port = address.rpartition("://")[2].rpartition(":")
    if colon:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_SECONDS).close()


def _need(members: Sequence[Job], work: Work, nodes: Sequence[dict]) -> Need:
    """The resources that the lanes of a cell need, with at most the cores of the largest node.

    Raises:
        UserError: for a cell that no node can hold.
    """
    most = {
        name: max((node["Resources"].get(name, 0) for node in nodes), default=0)
        for name in ("CPU", "GPU", "memory")
    }
    state, working = job_bytes(members[:1]).popitem()[1]
    gpus = 1 if work.strategy == "vmap" else 0
    cpus = min(len(members), int(most["CPU"])) if work.strategy == "map" else 1
    # Under `map`, each lane needs memory for its state, and each lane that advances also needs
    # memory for temporary arrays.
    size = math.ceil(WORKER_BYTES + len(members) * state + max(cpus, 1) * working)
    need = Need(cpus, gpus, size)
    asked = {"CPU": max(need.cpus, 1), "GPU": need.gpus, "memory": need.memory}
    for name, amount in asked.items():
        if amount > most[name]:
            scale, unit = (2**20, " MiB") if name == "memory" else (1, "")
            raise UserError(
                f"--cluster: {members[0].cell.words} needs {amount / scale:,.0f}{unit} {name}, but "
                f"the largest node has {most[name] / scale:,.0f}{unit}"
            )
    return need


def _check_nodes(
    ray: ModuleType, nodes: Sequence[dict], directory: RunDirectory, imports: Sequence[str]
) -> None:
    """Check the versions of every node, and its access to the run directory.

    Raises:
        UserError: naming the node and its problem.
    """
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    mine = versions_of(PACKAGES)
    token = uuid.uuid4().hex
    mark = directory.path / f".cluster-{token}"
    mark.write_text(token, "utf-8")
    try:
        probe = ray.remote(_probe)
        asked = {}
        for node in nodes:
            where = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            options = {"num_cpus": 0, "scheduling_strategy": where, "max_retries": 0}
            answer = probe.options(**options).remote(str(mark.resolve()), list(imports))
            asked[answer] = node
        for answer, node in asked.items():
            name = node["NodeManagerAddress"]
            try:
                versions, seen, problem = ray.get(answer, timeout=300)
            except Exception as error:
                if node["NodeID"] not in [other["NodeID"] for other in _alive(ray)]:
                    continue  # the node died, and Ray had not noticed it yet
                raise UserError(
                    f"--cluster: node {name} cannot work: {_last_line(error)}"
                ) from error
            if problem:
                raise UserError(f"--cluster: node {name}: {problem}")
            for package, version in mine.items():
                if versions.get(package) != version:
                    raise UserError(
                        f"--cluster: node {name} has {package} {versions.get(package)}, but this "
                        f"process has {version}; install the same versions"
                    )
            if seen != token:
                raise UserError(
                    f"--cluster: node {name} cannot read {directory.path.resolve()}; --out must "
                    "be on storage that all nodes share, under the same path"
                )
    finally:
        mark.unlink(missing_ok=True)


def _probe(mark: str, imports: list[str]) -> tuple[dict[str, str], str | None, str | None]:
    """On a node: return its versions, the content of the file ``mark``, and the import error.

    The content is None if the node cannot read the file; the error is None without an error.
    """
    problem = None
    try:
        import_modules(imports)
    except UserError as error:
        problem = str(error)
    path = Path(mark)
    return versions_of(PACKAGES), path.read_text("utf-8") if path.exists() else None, problem


def _train_cell(
    path: str, index: int, seeds: list[int], work: Work, cpus: int, imports: list[str]
) -> tuple[list[str], dict[str, Any]]:
    """On a node: train the lanes of a cell; return the complaints and a row for `TASKS`."""
    began = time.time()
    import_modules(imports)
    if work.strategy == "map":  # the task asked for no GPU, but may see those of its node
        with contextlib.suppress(RuntimeError):  # JAX_PLATFORMS excludes the CPU
            jax.config.update("jax_default_device", jax.local_devices(backend="cpu")[0])
    directory = RunDirectory.open(path)
    cell = directory.cells[index]
    # The jobs of all cells, because under `vmap` the longest window of all determines the program.
    jobs = directory.jobs(work.strategy)
    own = [job for job in jobs if job.cell == cell and job.seed in seeds]
    complaints: list[str] = []
    kept = [checkpoint_steps(directory.lanes.checkpoint_directory(cell, seed)) for seed in seeds]
    training = time.time()
    # The lanes must fit in the memory of this node, not in that of the driver.
    at_once = lanes_at_once(own, work.strategy, cpus or len(workers()), usable_memory())
    here = dataclasses.replace(work, workers=cpus or None, at_once=at_once)
    train_here(directory, own, here, complaints)
    report = {
        "cell": cell_name(cell),
        "seeds": seeds,
        "from_steps": [max(steps, default=0) for steps in kept],
        "node": platform.node(),
        "process": os.getpid(),
        "began": began,
        "training": training,
        "ended": time.time(),
    }
    return complaints, report


def _watch(
    ray: ModuleType,
    directory: RunDirectory,
    pending: dict[Any, list[Job]],
    complaints: list[str],
    interim: InterimResults,
    log: LogReader,
    quiet: bool,
) -> None:
    """Wait for the tasks; at Ctrl-C, tell them to write their checkpoints."""
    cells = len(pending)
    try:
        with _bar(quiet) as bar:
            everything = sum(cell.config.total_steps for cell in directory.cells)
            line = bar.add_task("", total=everything * len(directory.seeds), cells="")
            while pending:
                done, _ = ray.wait(list(pending), timeout=_POLL_SECONDS)
                for task in done:
                    jobs = pending.pop(task)
                    complaints += _outcome(ray, task, directory, jobs)
                words = f"{cells - len(pending)} of {cells} cells"
                bar.update(line, completed=log.steps(), cells=words)
                if done:
                    interim.refresh()
    except KeyboardInterrupt:
        with patient(_ENDING):
            for task in pending:
                ray.cancel(task, force=False)
            ray.wait(list(pending), num_returns=len(pending), timeout=_ENDING_SECONDS)
        raise


def _bar(quiet: bool) -> Progress:
    return Progress(
        TextColumn("{task.percentage:3.0f}%"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[cells]}"),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        disable=quiet,
    )


def _last_line(error: BaseException) -> str:
    """The last line of an error's message, as Ray's messages are tracebacks; else its type."""
    return (str(error).strip().splitlines() or [type(error).__name__])[-1]


def _outcome(ray: ModuleType, task: Any, directory: RunDirectory, jobs: Sequence[Job]) -> list[str]:
    """The complaints of an ended task; the reason of a failure is stored with its lanes."""
    try:
        complaints, report = ray.get(task)
        with (directory.path / TASKS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(report) + "\n")
        return complaints
    except Exception as error:
        reason = _last_line(error)
        for job in jobs:
            cell, seed = job.key
            if not directory.lanes.is_done(cell, seed):
                directory.lanes.write_error(cell, seed, reason)
        return [f"{jobs[0].cell.words} failed: {reason}"]
