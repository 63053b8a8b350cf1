"""Tests on simulated other systems, and the limits of a job."""

import os
import pathlib
import resource
import subprocess
import sys

import pytest

from rtd3jax.system import machine

ELSEWHERE = """
import os, sys
for name in ("sched_getaffinity", "sysconf", "O_NOFOLLOW"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("fcntl", "resource"):
    sys.modules[name] = None
"""
SWEEP = """
import pathlib
from rtd3jax import sweep
from rtd3jax.study import time_estimate
from rtd3jax.study.lock import deriver, writer
time_estimate.group_seconds = lambda jobs: 1.0
sweep.main("--env rover --algorithms td3 --seeds 1 --dry-run --out r".split())
with writer(pathlib.Path(), None), deriver(pathlib.Path()):
    print("written")
"""


def test_a_sweep_runs_without_the_names_that_only_linux_has(tmp_path):
    """No affinity (macOS), no fcntl, resource and sysconf (Windows)."""
    root = str(pathlib.Path(__file__).parents[2])
    found = subprocess.run(
        [sys.executable, "-c", ELSEWHERE + SWEEP],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": root},
        capture_output=True,
        text=True,
    )
    assert found.returncode == 0, found.stderr
    assert "lanes that fit" in found.stdout and "written" in found.stdout
    assert "this file system has no locks" in found.stderr


def test_cores_without_affinity(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity")
    assert machine.cores() == os.cpu_count()


@pytest.fixture
def alone(tmp_path, monkeypatch):
    """No limit but the machine's, and a place for control groups."""
    for name in ("SLURM_MEM_PER_NODE", "SLURM_MEM_PER_CPU", "SLURM_CPUS_ON_NODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(machine, "_CGROUP", tmp_path / "fs")
    monkeypatch.setattr(machine, "_OWN_CGROUPS", tmp_path / "own")
    monkeypatch.setattr(machine, "_physical", lambda: 64 * 2**30)
    monkeypatch.setattr(resource, "getrlimit", lambda which: (resource.RLIM_INFINITY,) * 2)

    def groups(own, **limits):
        (tmp_path / "own").write_text(own)
        for path, limit in limits.items():
            file = tmp_path / "fs" / path.replace("__", "/").replace("_in_", ".limit_in_")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(f"{limit}\n")

    return groups


def test_no_limit_is_the_machine(alone):
    assert machine.memory_limit() == 64 * 2**30


@pytest.mark.parametrize(("own", "above"), [("3000000000", "max"), ("max", "3000000000")])
def test_cgroup_v2_here_or_above(alone, own, above):
    alone("0::/slurm/job\n", **{"slurm__job__memory.max": own, "slurm__memory.max": above})
    assert machine.memory_limit() == 3_000_000_000


def test_cgroup_v1(alone):
    alone("5:cpu,cpuacct:/x\n4:memory:/docker/1\n", memory__docker__1__memory_in_bytes=3 * 10**9)
    assert machine.memory_limit() == 3 * 10**9


def test_a_container_that_does_not_see_the_hosts_path(alone):
    alone("0::/../../kubepods/pod1\n", **{"memory.max": 2 * 10**9})
    assert machine.memory_limit() == 2 * 10**9


def test_ulimit_counts_beside_what_is_mapped(alone, monkeypatch):
    limit = 2**45
    monkeypatch.setattr(machine, "_physical", lambda: 2**50)
    monkeypatch.setattr(resource, "getrlimit", lambda which: (limit, limit))
    assert 2**44 < machine.memory_limit() < limit
    monkeypatch.setattr(resource, "getrlimit", lambda which: (2**20, 2**20))
    assert machine.memory_limit() == 0


def test_slurm(alone, monkeypatch):
    monkeypatch.setenv("SLURM_MEM_PER_NODE", "4096")
    assert machine.memory_limit() == 4 * 2**30
    monkeypatch.delenv("SLURM_MEM_PER_NODE")
    monkeypatch.setenv("SLURM_MEM_PER_CPU", "1024")
    monkeypatch.setenv("SLURM_CPUS_ON_NODE", "3")
    assert machine.memory_limit() == 3 * 2**30
    monkeypatch.setenv("SLURM_MEM_PER_NODE", "0")  # all of the machine
    assert machine.memory_limit() == 3 * 2**30


def test_the_plan_asks_for_it(monkeypatch):
    from rtd3jax.study import memory_plan

    monkeypatch.setattr(memory_plan, "memory_limit", lambda: 123 * 2**30)
    assert memory_plan.usable_memory() == 123 * 2**30
