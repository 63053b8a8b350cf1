"""Tests of interrupted sweeps."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import jax
import pytest

from rtd3jax import sweep
from rtd3jax.study import execute, finish, recorder
from rtd3jax.study.derive import derive
from rtd3jax.study.log import LOG, append_rows, lane_of, read_log
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.training import lanes
from rtd3jax.training.devices import workers

STUDY = [
    *("--env", "rover", "--disturbances", "ar1-slip", "--algorithms", "td3", "h-td3"),
    *("--history-lengths", "2", "--seeds", "2", "--total-steps", "400", "--hidden-size", "4"),
    *("--batch-size", "4", "--learning-starts", "10", "--eval-every", "100"),
    *("--eval-episodes", "1", "--final-episodes", "2", "--quiet"),
]
TABLES = "curves.parquet", "episodes.parquet", "summary.md"


@pytest.fixture(autouse=True)
def no_page(monkeypatch):
    monkeypatch.setattr(finish, "refresh_page", lambda *_, **__: None)


def run(out, *more):
    return sweep.main([*STUDY, "--out", str(out), *more])


def contents(out):
    files = [out / name for name in TABLES] + sorted(out.glob("lanes/**/*.safetensors"))
    return {str(file.relative_to(out)): file.read_bytes() for file in files}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finish, "refresh_page", lambda *_, **__: None)
        out = tmp_path_factory.mktemp("whole") / "run"
        assert run(out) == 0
    return out


def cached():
    """The environment of processes that share the tests' compilations."""
    return {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
    }


@contextlib.contextmanager
def one_step_chunks(monkeypatch):

    with monkeypatch.context() as patch:
        patch.setattr(lanes, "_FIRST_CHUNK", 40)
        patch.setattr(lanes, "CHUNK_SECONDS", 0.0)
        yield patch


# A process that dies, as from SIGKILL, when it is about to move the file of this name.
DYING = """
import functools, os, signal, sys
from rtd3jax import sweep
from rtd3jax.study import ceilings, references
from rtd3jax.system import files
from rtd3jax.training import lanes

references.EPISODES = 2
ceilings.ceiling = functools.partial(ceilings.ceiling, episodes=100)
lanes._FIRST_CHUNK, lanes.CHUNK_SECONDS = 40, 0.0
part, times = sys.argv[1], int(sys.argv[2])
real = os.replace

def replace(source, target):
    global times
    if part in str(target):
        times -= 1
        if times == 0:
            with open(source, "r+b") as file:
                file.truncate(os.path.getsize(source) // 2)
            os.kill(os.getpid(), signal.SIGKILL)
    real(source, target)

files.os.replace = replace
sys.exit(sweep.main(sys.argv[3:]))
"""


@pytest.mark.parametrize(
    ("part", "times"),
    [
        ("step-", 30),
        pytest.param("config.json", 1, marks=pytest.mark.slow),
        pytest.param("episodes.parquet", 1, marks=pytest.mark.slow),
    ],
)
def test_killed_while_it_writes(part, times, whole, tmp_path):
    out = tmp_path / "run"
    arguments = [*STUDY, "--out", str(out), "--checkpoint-every", "20steps"]
    dying = subprocess.run(
        [sys.executable, "-c", DYING, part, str(times), *arguments],
        env=cached(),
        capture_output=True,
    )
    assert dying.returncode == -signal.SIGKILL, dying.stderr.decode()[-2000:]
    assert list(out.rglob(".*.tmp"))
    assert not (out / "summary.md").exists()
    assert run(out) == 0
    assert contents(out) == contents(whole)
    assert not list(out.rglob("checkpoints/**/*.tmp"))


@pytest.mark.slow
def test_a_killed_simulators_lanes_end_with_the_same_bits(tmp_path):
    """A checkpoint falls into an episode, which is replayed in a simulator of the new process."""
    out = tmp_path / "run"
    study = [
        *("--env", "gymnasium:Pendulum-v1", "--algorithms", "td3", "lstm-td3-1ha1hc"),
        *("--history-lengths", "2", "--seeds", "2", "--total-steps", "400", "--hidden-size", "8"),
        *("--batch-size", "4", "--learning-starts", "10", "--eval-every", "150"),
        *("--eval-episodes", "1", "--final-episodes", "2", "--quiet", "--no-report"),
        *("--checkpoint-every", "100steps"),
    ]
    assert sweep.main([*study, "--out", str(tmp_path / "whole")]) == 0
    dying = subprocess.run(
        [sys.executable, "-c", DYING, "step-", "5", *study, "--out", str(out)],
        env=cached(),
        capture_output=True,
    )
    assert dying.returncode == -signal.SIGKILL, dying.stderr.decode()[-2000:]
    kept = {int(file.stem.partition("-")[2]) for file in out.rglob("step-*.safetensors")}
    assert any(step % 200 for step in kept), kept  # an episode has 200 steps
    assert sweep.main([*study, "--out", str(out)]) == 0
    assert contents(out) == contents(tmp_path / "whole")


def test_sigterm_leaves_checkpoints_and_the_rest_is_the_same(whole, tmp_path, monkeypatch, capsys):
    out = tmp_path / "run"
    real = recorder.Recorder.update

    def update(self, group):
        real(self, group)
        if group.step >= 40:
            os.kill(os.getpid(), signal.SIGTERM)

    two = (workers() * 2)[:2]  # so that some of the four lanes have not begun
    with one_step_chunks(monkeypatch) as patch:
        patch.setattr(recorder.Recorder, "update", update)
        patch.setattr(execute, "workers", lambda: two)
        assert run(out) == 143
    assert "repeat the command to train the lanes" in capsys.readouterr().out
    assert list(out.rglob("step-*.safetensors"))
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    assert sweep.main(["--out", str(out), "--status"]) == 0
    status = capsys.readouterr().out
    assert "interrupted" in status and "next start at step" in status and "planned" in status
    assert run(out) == 0
    assert contents(out) == contents(whole)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_an_interrupt_between_two_stages_is_one_line(number, status, tmp_path, monkeypatch, capsys):
    import rtd3jax.study.run as stages

    def interrupted(cells):
        os.kill(os.getpid(), number)
        time.sleep(10)  # another thread may receive the signal

    monkeypatch.setattr(stages, "references_of", interrupted)
    assert run(tmp_path / "run") == status
    assert capsys.readouterr().err == "interrupted: repeat the command\n"
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_one_worker_finishes_what_two_began(whole, tmp_path, monkeypatch):
    out = tmp_path / "run"

    def interrupt(self, group):
        raise KeyboardInterrupt

    with one_step_chunks(monkeypatch) as patch:
        patch.setattr(recorder.Recorder, "update", interrupt)
        assert run(out) == 130
    one, used = workers()[:1], []
    real = execute.advance_groups
    monkeypatch.setattr(execute, "workers", lambda: one)
    monkeypatch.setattr(
        execute, "advance_groups", lambda *rest: (used.append(rest[-1]), real(*rest))
    )
    assert run(out) == 0
    assert used == [one]
    assert contents(out) == contents(whole)


def test_the_log_has_each_evaluation_once_however_often_it_was_cut(whole, tmp_path, monkeypatch):
    out = tmp_path / "run"
    calls = []
    real = recorder.Recorder.update

    def update(self, group):
        real(self, group)
        calls.append(1)
        if len(calls) % 20 == 0:
            raise KeyboardInterrupt

    with one_step_chunks(monkeypatch) as patch:
        patch.setattr(recorder.Recorder, "update", update)
        assert run(out) == 130
        with (out / LOG).open("a") as log:
            log.write('{"env": "rover", "disturb')  # a line that SIGKILL cut short
        assert run(out) in (0, 130)
    assert run(out) == 0
    log = [line for line in (out / LOG).read_text().splitlines() if line.endswith("}")]
    keys = [tuple(list(json.loads(line).values())[:6]) for line in log]
    assert len(keys) == len(set(keys)) == 2 * 2 * 4
    assert len(read_log(out / LOG)) == len(keys)


def test_rows_of_the_log_that_fit_only_in_part_are_written_to_the_end():
    class Part:
        """A file that takes ten bytes at a time."""

        content = b""

        def open(self, *_, **__):
            return contextlib.nullcontext(self)

        def write(self, data):
            self.content += data[:10]
            return min(len(data), 10)

    path, rows = Part(), [{"step": 1, "return": 2.0}, {"step": 2, "return": 3.0}]
    append_rows(path, rows)
    assert [json.loads(line) for line in path.content.splitlines()] == rows


@pytest.mark.slow
def test_two_processes_with_a_shard_each_merge_to_the_same_tables(whole, tmp_path):
    out = tmp_path / "run"
    script = "import functools, sys; from rtd3jax import sweep; "
    script += "from rtd3jax.study import ceilings, references; references.EPISODES = 2; "
    script += "ceilings.ceiling = functools.partial(ceilings.ceiling, episodes=100); "
    script += "sys.exit(sweep.main(sys.argv[1:]))"
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", script, *STUDY, "--out", str(out), "--shard", f"{i}/2"],
            env=cached(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        for i in (1, 2)
    ]
    for process in processes:
        _, errors = process.communicate()
        assert process.returncode == 0, errors.decode()[-2000:]
    assert contents(out) == contents(whole)


def test_tables_wait_for_another_shards_tables(whole, tmp_path, monkeypatch):
    from rtd3jax.study.lock import deriver

    out = tmp_path / "run"
    shutil.copytree(whole, out)
    module = sys.modules["rtd3jax.study.derive"]
    real, entered = module._derive, threading.Event()
    monkeypatch.setattr(module, "_derive", lambda *args: (entered.set(), real(*args)))
    directory = RunDirectory.open(out)
    with deriver(out):
        thread = threading.Thread(target=derive, args=(directory, []), kwargs={"pictures": False})
        thread.start()
        assert not entered.wait(0.3)
    thread.join()
    assert entered.is_set()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seeds": ["../../../outside"]}, "not a study's configuration"),
        ({"seeds": [-1]}, "not a study's configuration"),
        ({"final_episodes": "many"}, "not a study's configuration"),
        ({"cells": [{"env": "../..", "disturbance": "../../x"}]}, None),
        ({"cells": [{"env": "rover", "disturbance": "none", "import": "os"}]}, "field 'import'"),
        ({"cells": "rover"}, "not a study's configuration"),
    ],
)
def test_a_hostile_configuration_is_read_without_leaving_the_directory(
    change, message, tmp_path, capsys
):
    out = tmp_path / "in" / "run"
    out.mkdir(parents=True)
    study = {
        "cells": [{"env": "rover", "disturbance": "none"}],
        "seeds": [0],
        "final_episodes": 1,
        **change,
    }
    (out / "config.json").write_text(json.dumps({"study": study}))
    before = sorted(tmp_path.rglob("*"))
    status = sweep.main(["--out", str(out), "--status"])
    error = capsys.readouterr().err
    if message is None:
        assert status == 0 and not error
    else:
        assert status == 2 and message in error and error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_links_that_lead_outside_are_refused(tmp_path, capsys):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "step-000000001.safetensors").write_text("mine")
    out = tmp_path / "run"
    out.mkdir()
    (out / "checkpoints").symlink_to(outside)
    assert run(out) == 2
    assert "holds no study" in capsys.readouterr().err
    (out / "checkpoints").unlink()
    assert run(out) == 0
    for file in out.glob("lanes/**/*.safetensors"):
        file.unlink()
    shutil.rmtree(out / "checkpoints")
    (out / "checkpoints").symlink_to(outside)
    assert run(out) != 0
    assert "leads outside" in capsys.readouterr().err
    assert (outside / "step-000000001.safetensors").read_text() == "mine"


def test_a_directory_that_cannot_be_written_is_one_line(tmp_path, capsys, monkeypatch):
    import errno

    from rtd3jax.study import lock

    real = os.open

    def read_only(path, flags, *rest):
        if flags & os.O_CREAT:
            raise OSError(errno.EROFS, "Read-only file system", str(path))
        return real(path, flags, *rest)

    monkeypatch.setattr(lock.os, "open", read_only)
    assert run(tmp_path / "run") == 2
    error = capsys.readouterr().err
    assert "Read-only file system" in error and error.count("\n") == 1


def test_a_lane_that_is_trained_anew_is_logged_again(whole, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    rows = read_log(out / LOG)
    first = rows[0]
    text = json.dumps({**first, "return": first["return"] + 1.0}) + "\n"
    text += "".join(json.dumps(row) + "\n" for row in rows[1:])
    (out / LOG).write_text(text)
    shutil.rmtree(out / "lanes")
    assert run(out) == 0
    again = read_log(out / LOG)
    assert len(again) == len(rows) + 1
    (added,) = again[len(rows) :]
    assert (lane_of(added), added["step"]) == (lane_of(first), first["step"])
    assert added["return"] == first["return"]
