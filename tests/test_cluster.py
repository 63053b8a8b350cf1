"""Tests of several processes in a job, and of the requests to a Ray cluster."""

import json
import os
import pathlib
import socket
import subprocess
import sys
import time

import jax
import pytest

from rtd3jax import sweep
from rtd3jax.config import Config
from rtd3jax.errors import UserError
from rtd3jax.study import cluster, hosts
from rtd3jax.study.cells import Cell, Grid, cell_jobs, make_cells
from rtd3jax.study.execute import Work
from rtd3jax.study.log import LOG
from rtd3jax.study.log_reader import LogReader
from rtd3jax.study.rundir import RunDirectory

STUDY = [
    *("--env", "rover", "--disturbances", "ar1-slip", "--algorithms", "td3"),
    *("--seeds", "3", "--total-steps", "60", "--hidden-size", "4", "--batch-size", "4"),
    *("--learning-starts", "10", "--eval-every", "30", "--eval-episodes", "1"),
    *("--final-episodes", "2", "--quiet", "--no-report"),
]


def process(out, devices, rank=None, of=2):
    """A sweep with virtual CPU devices, one of ``of`` processes where it has a rank."""
    flags = f"--xla_force_host_platform_device_count={devices}"
    environment = {
        **os.environ,
        "XLA_FLAGS": flags,
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
    }
    command = [sys.executable, "-m", "rtd3jax.sweep", *STUDY, "--out", str(out)]
    if rank is not None:
        command.append("--distributed")
        environment |= {"JAX_NUM_PROCESSES": str(of), "JAX_PROCESS_ID": str(rank)}
        environment["JAX_COORDINATOR_ADDRESS"] = "127.0.0.1:18217"
    pipe = subprocess.PIPE
    return subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe)


def contents(out):
    names = ("curves.parquet", "episodes.parquet", "summary.md")
    files = [*(out / name for name in names), *sorted(out.glob("lanes/**/*.safetensors"))]
    return {str(file.relative_to(out)): file.read_bytes() for file in files}


DEVICES = int(os.environ.get("RTD3JAX_TEST_DEVICES", "2"))
"""Each compiles its own programs, which takes most of the time of this test."""


@pytest.mark.slow
def test_two_processes_with_half_the_devices_each_give_the_bits_of_one_with_all(tmp_path):
    alone, joined = tmp_path / "alone", tmp_path / "joined"
    running = [process(alone, DEVICES)]
    running += [process(joined, DEVICES // 2, rank) for rank in (0, 1)]
    for one in running:
        _, error = one.communicate(timeout=240)
        assert one.returncode == 0, error.decode()[-2000:]
    found = contents(joined)
    assert len(found) == 3 + 3 and found == contents(alone)


def test_a_relative_start_is_refused_on_a_cluster():
    cells = [
        Cell("rover", "none", Config("td3", start=start)) for start in ("", "/shared/a", "~/a")
    ]
    cluster.check_absolute_starts(cells)
    relative = Cell("rover", "none", Config("td3", start="runs/a@none"))
    with pytest.raises(UserError, match="--start runs/a@none is relative.* absolute path"):
        cluster.check_absolute_starts([*cells, relative])


def test_a_process_without_a_job_is_told_what_to_set(tmp_path):
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("SLURM", "OMPI"))}
    done = subprocess.run(
        [
            *(sys.executable, "-P", hosts.launch.__file__, "rtd3jax.sweep"),
            *(*STUDY, "--out", str(tmp_path / "run")),
        ],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2 and "JAX_COORDINATOR_ADDRESS" in done.stderr
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1


def test_each_lane_belongs_to_one_process(monkeypatch):
    class Device:
        def __init__(self, process):
            self.process_index = process

    monkeypatch.setattr(hosts.jax, "devices", lambda: [Device(p) for p in (0, 0, 1, 2, 2)])
    jobs = list(range(23))
    shares = []
    for index in range(3):
        monkeypatch.setattr(hosts.jax, "process_index", lambda index=index: index)
        shares.append(hosts.own_share(jobs))
    assert sorted(sum(shares, [])) == jobs
    assert [len(share) for share in shares] == [10, 5, 8]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--shard", "1/2", "--cluster", "auto"], "choose one"),
        (["--distributed"], "jax.distributed.initialize()"),
    ],
)
def test_bad_input_is_one_line(more, message, tmp_path, capsys):
    assert sweep.main([*STUDY, *more, "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("error: ") and error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def nodes(**resources):
    return [{"Resources": {"CPU": 1, "memory": 2**30, **resources}}, {"Resources": {"CPU": 2}}]


def jobs(**overrides):
    cells = make_cells([Grid("rover", ("ar1-slip",), ("td3",))], overrides)
    return cell_jobs(cells, range(4), "map")


def test_a_cell_asks_for_cores_and_the_planned_memory():
    work = Work("map", 4)
    need = cluster._need(jobs(), work, nodes(memory=8 * 2**30))
    assert need.cpus == 2 and need.gpus == 0  # four lanes, on the two cores of the largest node
    larger = cluster._need(jobs(replay_capacity=1_000_000), work, nodes(memory=8 * 2**30))
    assert larger.memory - need.memory > 4 * 20 * 2**20  # four replays


def test_a_task_that_asked_for_no_gpu_uses_none(tmp_path, monkeypatch):
    cells = make_cells([Grid("rover", ("ar1-slip",), ("td3",))], {})
    RunDirectory.create(tmp_path / "run", cells, [0], 1)
    monkeypatch.setattr(cluster, "train_here", lambda *_: None)
    before = jax.config.values["jax_default_device"]
    try:
        for strategy, expected in (("vmap", before), ("map", jax.local_devices(backend="cpu")[0])):
            work = Work(strategy, 1, quiet=True)
            cluster._train_cell(str(tmp_path / "run"), 0, [0], work, strategy == "map", [])
            assert jax.config.values["jax_default_device"] == expected
    finally:
        jax.config.update("jax_default_device", before)


def test_a_cell_that_no_node_can_hold_is_refused():
    with pytest.raises(UserError, match="memory, but the largest node has 1,024 MiB"):
        cluster._need(jobs(replay_capacity=5_000_000), Work("map", 4), nodes())
    with pytest.raises(UserError, match="needs 1 GPU, but the largest node has 0"):
        cluster._need(jobs(), Work("vmap", 4), nodes(memory=8 * 2**30))


def test_on_ray_the_tables_are_the_same_though_nodes_and_driver_die():
    pytest.importorskip("ray", reason="Ray is not installed (pip install 'rtd3jax[ray]')")
    script = pathlib.Path(__file__).parents[1] / "experiments" / "reliability" / "cluster.py"
    done = subprocess.run([sys.executable, script, "--quick"], stdout=subprocess.PIPE, text=True)
    assert done.returncode == 0 and done.stdout.count("as it should be") >= 3


class FakeRay:
    """A cluster whose tasks all have the same answer, or raise it."""

    def __init__(self, answer, alive=()):
        self._answer = answer
        self._alive = alive

    def nodes(self):
        return [{**node, "Alive": node["NodeID"] in self._alive} for node in [NODE]]

    def remote(self, function):
        return self

    def options(self, **_):
        return type("Task", (), {"remote": staticmethod(lambda *_: object())})

    def get(self, *_, **__):
        if isinstance(self._answer, Exception):
            raise self._answer
        return self._answer


NODE = {"NodeID": "a", "NodeManagerAddress": "10.0.0.7"}


@pytest.fixture
def scheduling(monkeypatch):
    """Of Ray, the one module that probes need."""
    module = type(sys)("ray.util.scheduling_strategies")
    module.NodeAffinitySchedulingStrategy = lambda *_, **__: None
    for name in ("ray", "ray.util"):
        monkeypatch.setitem(sys.modules, name, type(sys)(name))
    monkeypatch.setitem(sys.modules, "ray.util.scheduling_strategies", module)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"jax": "0.1"}, "has jax 0.1, but this process has"),
        ({}, "cannot read"),
    ],
)
@pytest.mark.usefixtures("scheduling")
def test_a_node_that_cannot_do_the_work_is_named(change, message, tmp_path):
    versions = {**cluster.versions_of(cluster.PACKAGES), **change}
    ray = FakeRay((versions, None, None))
    directory = type("Directory", (), {"path": tmp_path})
    with pytest.raises(UserError, match=f"node 10.0.0.7 {message}"):
        cluster._check_nodes(ray, [NODE], directory, [])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("scheduling")
def test_a_node_that_died_meanwhile_is_left_out_and_one_that_cannot_answer_is_not(tmp_path):
    directory = type("Directory", (), {"path": tmp_path})
    error = RuntimeError("no answer")
    cluster._check_nodes(FakeRay(error, alive=()), [NODE], directory, [])
    with pytest.raises(UserError, match="node 10.0.0.7 cannot work: no answer"):
        cluster._check_nodes(FakeRay(error, alive=("a",)), [NODE], directory, [])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("address", ["127.0.0.1:{}", "ray://127.0.0.1:{}", "[::1]:{}"])
def test_where_nobody_listens_there_is_no_cluster(address):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    began = time.monotonic()
    with (
        pytest.raises(UserError, match="there is no Ray cluster"),
        cluster._connected(FakeRay(None), address.format(port)),
    ):
        pass
    assert time.monotonic() - began < 5.0


@pytest.mark.parametrize("address", ["127.0.0.1:port", "127.0.0.1:99999", "nowhere.invalid:6379"])
def test_what_is_no_address_is_refused(address):
    with (
        pytest.raises(UserError, match="there is no Ray cluster"),
        cluster._connected(FakeRay(None), address),
    ):
        pass


def test_the_tasks_line_is_json(tmp_path):
    ray = FakeRay(([], {"cell": "a", "from_steps": [0]}))
    directory = type("Directory", (), {"path": tmp_path})
    assert cluster._outcome(ray, None, directory, []) == []
    assert json.loads((tmp_path / cluster.TASKS).read_text())["cell"] == "a"


def test_the_growing_log_is_read_once_and_by_whole_lines(tmp_path):
    cells = make_cells([Grid("rover", ("ar1-slip",), ("td3",))], {})
    directory = RunDirectory.create(tmp_path / "run", cells, [0, 1], 2)
    fed = []
    logger = type("Logger", (), {"log": lambda self, cell, seed, row: fed.append(row["step"])})()

    def line(seed, step):
        return json.dumps({**cells[0].key, "seed": seed, "step": step, "return": -1.0}) + "\n"

    path = directory.path / LOG
    path.write_text(line(0, 10))
    log = LogReader(directory, logger)
    assert log.steps() == 10 and fed == []  # the trackers had it before
    with path.open("a") as file:
        file.write(line(0, 20) + line(1, 10) + line(1, 20)[:30])
        file.flush()
        assert log.steps() == 30 and fed == [20, 10]
        file.write(line(1, 20)[30:])
        file.flush()
        assert log.steps() == 40 and fed == [20, 10, 20]
    assert log.steps() == 40 and len(fed) == 3
