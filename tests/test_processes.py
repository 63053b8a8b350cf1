"""Tests of a sweep whose lanes are trained in several processes.

The networks are tiny, so that XLA does not divide their sums by the number of cores. Therefore
threads and processes give the same bits here, unlike with networks of the usual size.
"""

import os
import pathlib
import queue
import signal
import subprocess
import sys
import time

import jax
import pytest

from rtd3jax import sweep
from rtd3jax.errors import UserError
from rtd3jax.study import process_plan, processes
from rtd3jax.study.cells import Grid, cell_jobs, make_cells
from rtd3jax.study.crew import Crew
from rtd3jax.study.lock import is_held
from rtd3jax.study.log import LOG, read_log
from rtd3jax.study.report import data
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.training.grouping import make_groups

STEPS, SEEDS = 4_000, 3
STUDY = [
    *("--env", "rover", "--disturbances", "ar1-slip", "--algorithms", "td3"),
    *("--seeds", str(SEEDS), "--total-steps", str(STEPS), "--hidden-size", "8"),
    *("--batch-size", "16", "--learning-starts", "20", "--eval-every", "1000"),
    *("--eval-episodes", "1", "--final-episodes", "2", "--checkpoint-every", "300steps"),
    *("--quiet", "--no-report"),
]


@pytest.fixture(autouse=True)
def cache(monkeypatch):
    """Processes share the tests' compilations."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", jax.config.jax_compilation_cache_dir)
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")


needs_two_cores = pytest.mark.skipif(process_plan.cores() < 2, reason="there is one core")


def run(out, *more):
    return sweep.main([*STUDY, "--out", str(out), *more])


def contents(out):
    tables = "curves.parquet", "episodes.parquet", "metrics.parquet", "summary.md"
    files = [*(out / name for name in tables), *sorted(out.glob("lanes/**/*.safetensors"))]
    return {str(file.relative_to(out)): file.read_bytes() for file in files}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "run"
    assert run(out, "--processes", "1") == 0
    return out


@pytest.fixture
def at_a_lanes_first_steps(monkeypatch):
    """Call a function with the crew when a lane has begun to learn, once for each function."""
    waiting = []
    real = processes._Study.listen

    def listen(self):
        ended = real(self)
        members = [m for m in self._crew.members if any(0 < g.step < STEPS for g in m.lanes)]
        if members and waiting:
            waiting.pop(0)(self._crew, members)
        return ended

    monkeypatch.setattr(processes._Study, "listen", listen)
    return waiting.append


def is_gone(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@needs_two_cores
def test_a_killed_process_is_replaced_and_every_file_is_the_same(
    whole, tmp_path, at_a_lanes_first_steps, monkeypatch
):
    """The other process goes on, and the lane continues from its checkpoint."""
    out = tmp_path / "run"
    begun, pinned, killed = [], [], []
    real = Crew.begin

    def begin(self, cores):
        real(self, cores)
        begun.append(self.members[-1].pid)

    def kill(crew, members):
        pinned.extend(os.sched_getaffinity(member.pid) for member in crew.members)
        killed.append(members[0].pid)
        os.kill(members[0].pid, signal.SIGKILL)

    monkeypatch.setattr(Crew, "begin", begin)
    at_a_lanes_first_steps(kill)
    assert run(out, "--processes", "2") == 0
    assert len(begun) == 3 and killed[0] in begun and all(map(is_gone, begun))
    assert pinned == [set(cores) for cores in process_plan.shares_of(2, lanes_of(2), "map").cores]
    assert contents(out) == contents(whole)
    keys = [(row["seed"], row["step"]) for row in read_log(out / LOG)]
    assert sorted(keys) == [(s, k) for s in range(SEEDS) for k in range(1000, STEPS + 1, 1000)]
    assert not list(out.rglob("step-*.safetensors"))


@needs_two_cores
@pytest.mark.slow
def test_after_sigterm_the_rest_is_the_same(whole, tmp_path, at_a_lanes_first_steps, capsys):
    out = tmp_path / "run"
    pids = []

    def interrupt(crew, members):
        pids.extend(member.pid for member in crew.members)
        os.kill(os.getpid(), signal.SIGTERM)

    at_a_lanes_first_steps(interrupt)
    assert run(out, "--processes", "2") == 143
    assert "repeat the command" in capsys.readouterr().out
    assert len(pids) == 2 and all(map(is_gone, pids))
    assert list(out.rglob("step-*.safetensors")) and not is_held(out)
    assert run(out, "--processes", "1") == 0
    assert contents(out) == contents(whole)


@needs_two_cores
@pytest.mark.slow
@pytest.mark.parametrize("how", ["ctrl-c", "kill"])
def test_processes_end_with_their_sweep_after_checkpoints(how, whole, tmp_path):
    """A terminal sends Ctrl-C to all of them; of a sweep that is killed, only the pipe ends."""
    out = tmp_path / "run"
    script = "import sys; from rtd3jax import sweep; from rtd3jax.study import references; "
    script += "references.EPISODES = 2; sys.exit(sweep.main(sys.argv[1:]))"
    parent = subprocess.Popen(
        [sys.executable, "-c", script, *STUDY, "--out", str(out), "--processes", "2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    while not list(out.rglob("step-*.safetensors")):
        assert parent.poll() is None
        time.sleep(0.02)
    if how == "kill":
        parent.kill()
    else:
        os.killpg(parent.pid, signal.SIGINT)
    _, error = parent.communicate()  # to the end of the processes too, which have this pipe
    assert parent.returncode == (-signal.SIGKILL if how == "kill" else 130)
    assert b"Traceback" not in error and not is_held(out)
    assert list(out.rglob("step-*.safetensors"))
    assert run(out, "--processes", "1") == 0
    assert contents(out) == contents(whole)


@needs_two_cores
@pytest.mark.slow
def test_a_simulator_and_an_imported_module_work_in_processes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pathlib.Path("mine_for_processes.py").write_text(
        "import gymnasium\n"
        "gymnasium.register('Mine-v0', 'gymnasium.envs.classic_control:PendulumEnv', "
        "max_episode_steps=50)\n"
    )
    study = [
        *("--env", "gymnasium:Mine-v0", "--import", "mine_for_processes", "--algorithms", "td3"),
        *("--seeds", "2", "--total-steps", "300", "--hidden-size", "8", "--batch-size", "4"),
        *("--learning-starts", "10", "--eval-every", "150", "--eval-episodes", "1"),
        *("--final-episodes", "2", "--quiet", "--no-report"),
    ]
    for count in ("1", "2"):
        assert sweep.main([*study, "--out", count, "--processes", count]) == 0
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--processes", "0"], "must be from 1"),
        (["--processes", "x"], "invalid int value: 'x'"),
        (["--processes", "2", "--shard", "1/2"], "choose one of them"),
        (["--processes", "2", "--cluster", "auto"], "choose one of them"),
        (["--processes", "2", "--strategy", "vmap"], "--strategy map"),
        (["--processes", "9999"], "give at most as many"),
    ],
)
def test_bad_input_is_one_line(more, message, tmp_path, capsys):
    assert run(tmp_path / "run", *more) == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("error: ") and error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def lanes_of(seeds=4, algorithms=("td3",), **overrides):
    cells = make_cells([Grid("rover", ("ar1-slip",), algorithms, (2,))], overrides)
    return cell_jobs(cells, range(seeds), "map")


def test_threads_unless_processes_are_asked_for(monkeypatch):
    monkeypatch.setattr(process_plan, "cores", lambda: 2)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {4, 6})
    monkeypatch.setattr(process_plan, "memory_limit", lambda: 16 * 2**30)
    jobs = lanes_of()

    for threads in (process_plan.shares_of(1, jobs, "map"), process_plan.shares_of(2, [], "map")):
        assert threads.processes == 1 and "a thread per core" in str(threads)
    two = process_plan.shares_of(2, jobs, "map")
    assert two.cores == ((4,), (6,)) and two.lanes == 1
    assert str(two) == "2 processes, each pinned to 1 core"
    monkeypatch.setattr(process_plan, "memory_limit", lambda: 2**20)
    with pytest.raises(UserError, match="GiB"):
        process_plan.shares_of(2, jobs, "map")


def test_a_lane_has_as_many_cores_however_many_lanes_wait(monkeypatch):
    """Its bits depend on them, and a repeated command has fewer lanes left."""
    monkeypatch.setattr(process_plan, "cores", lambda: 5)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {1, 2, 3, 5, 8})
    monkeypatch.setattr(process_plan, "memory_limit", lambda: 16 * 2**30)
    jobs = lanes_of(6)
    for waiting, lanes in ((6, 2), (3, 2), (2, 1)):
        shares = process_plan.shares_of(2, jobs[:waiting], "map")
        assert shares.cores == ((1, 2), (3, 5)) and shares.lanes == lanes
    one = process_plan.shares_of(2, jobs[:1], "map")
    assert one.cores == ((1, 2),) and not one.here
    assert str(one) == "1 process, pinned to 2 cores"


def test_rows_of_processes_that_write_at_the_same_time_are_of_one_session(tmp_path):
    cell = lanes_of(1)[0].cell

    def timing(*seconds):
        rows = [{**cell.key, "seed": 0, "step": 10, "seconds": second} for second in seconds]
        return data._timing(rows, type("Directory", (), {"path": tmp_path}))

    assert timing(10.0, 10.003, 10.001, 20.0)["seconds"] == 20.0
    assert timing(10.0, 10.003, 4.0, 20.0)["sessions"] == 2  # after a restart


class Member:
    """A process that only takes orders."""

    def __init__(self, ready=True):
        self.cores, self.lanes, self.executable, self.ready = (0,), [], None, ready
        self.orders = []

    def order(self, lanes, names):
        self.lanes, self.executable = list(lanes), lanes[0].jobs[0].executable
        self.orders.append(names)

    def wait(self, seconds):
        return -9

    def kill(self):
        pass


class FakeCrew:
    def __init__(self, count, ready=True):
        self.members = [Member(ready) for _ in range(count)]
        self.told = queue.SimpleQueue()

    def begin(self, cores):
        self.members.append(Member())

    def messages(self, seconds):
        while not self.told.empty():
            yield self.told.get()


@pytest.fixture
def study(tmp_path):
    """A function that makes a study of two programs, with two seeds each, and its crew."""

    def make(count, ready=True):
        jobs = lanes_of(2, ("td3", "h-td3"))
        directory = RunDirectory.create(
            tmp_path / "run", list(dict.fromkeys(j.cell for j in jobs)), [0, 1], 2
        )
        crew, complaints = FakeCrew(count, ready), []
        made = processes._Study(
            directory, make_groups(jobs, "map", 1), crew, 1, complaints, lambda group: None
        )
        return made, crew, complaints, directory

    return make


def test_each_process_goes_on_with_the_program_that_it_has(study):
    made, crew, _, _ = study(2)
    a, b = crew.members
    made.give()
    assert (a.orders, b.orders) == ([[(0, 0)]], [[(1, 0)]])
    crew.told.put((b, {"ended": []}))
    assert made.listen()
    made.give()
    assert b.orders[1:] == [[(1, 1)]] and len(a.orders) == 1
    crew.told.put((b, {"ended": ["something"]}))
    made.listen()
    made.give()
    assert b.orders[2:] == [[(0, 1)]]  # there is nothing else
    assert made.left == 2


def test_a_lane_whose_processes_are_all_killed_fails(study):
    made, crew, complaints, directory = study(1)
    for _ in range(processes._ATTEMPTS):
        made.give()
        (member,) = crew.members
        assert member.orders == [[(0, 0)]]
        crew.told.put((member, None))
        made.listen()
    assert made.left == 3
    (line,) = complaints
    job = made._lanes[0, 0].jobs[0]
    assert (
        line.startswith(f"{job.cell.words} seed 0 failed: 3 processes ended") and "signal 9" in line
    )
    assert "signal 9" in directory.lanes.error_path(*job.key).read_text()
    made.give()
    assert crew.members[0].orders == [[(0, 1)]]  # the other lanes go on


def test_processes_that_end_at_their_start_are_given_up(study):
    made, crew, _, _ = study(1, ready=False)
    for attempt in range(processes._ATTEMPTS):
        (member,) = crew.members
        member.ready = False
        crew.told.put((member, None))
        if attempt < processes._ATTEMPTS - 1:
            made.listen()
    with pytest.raises(UserError, match="ended at their start"):
        made.listen()


def test_an_error_of_a_process_is_raised(study):
    made, crew, _, _ = study(1)
    crew.told.put((crew.members[0], {"error": "the disk is full"}))
    with pytest.raises(UserError, match="the disk is full"):
        made.listen()
