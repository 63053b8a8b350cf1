"""Tests a sweep on a Ray cluster: the tables are the same, even if nodes and the driver die.

Usage: python experiments/reliability/cluster.py [--quick]

The script needs Ray (pip install 'rtd3jax[ray]'). It starts Ray's test cluster on this machine,
with a head and three nodes of one CPU each, and trains twelve small cells on it: without
interruptions, with two killed nodes, and with a killed driver. It compares every table and lane
with a local run, byte by byte. The exit status is 1 if a file differs, or if no lane continued from
a checkpoint after its node had died.
"""

import argparse
import contextlib
import json
import os
import pathlib
import signal
import statistics
import subprocess
import sys
import tempfile
import time

from kill_and_resume import contents  # in the same directory

STUDY = [
    *("--env", "rover", "--disturbances", "ar1-slip", "ar1-slip-fast", "ar1-slip-slow"),
    *("--algorithms", "td3", "h-td3", "lstm-td3-1ha1hc", "lstm-td3", "--history-lengths", "2"),
    *("--seeds", "2", "--total-steps", "4000", "--hidden-size", "16", "--batch-size", "16"),
    *("--learning-starts", "100", "--eval-every", "500", "--eval-episodes", "2"),
    *("--final-episodes", "3", "--checkpoint-every", "200steps", "--quiet", "--no-report"),
]
QUICK = ["--disturbances", "ar1-slip", "--algorithms", "td3", "--total-steps", "20000"]


def sweep(out, more, address=None):
    """Start a sweep."""
    where = [] if address is None else ["--cluster", address]
    command = [sys.executable, "-m", "rtd3jax.sweep", *STUDY, *more, "--out", str(out), *where]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def wait_for_checkpoints(out, process, new=1):
    """Wait for ``new`` more checkpoints of running lanes; return False if the sweep ends first."""
    before = set(out.glob("checkpoints/**/step-*.safetensors"))
    while process.poll() is None:
        if len(set(out.glob("checkpoints/**/step-*.safetensors")) - before) >= new:
            return True
        time.sleep(0.05)
    return False


def tasks(out):
    """The ended tasks."""
    return [json.loads(line) for line in (out / "cluster.jsonl").read_text().splitlines()]


def overheads(out):
    """Overhead of each task in seconds, for processes that had a task before."""
    found, ends = [], {}
    for task in sorted(tasks(out), key=lambda task: task["began"]):
        if task["process"] in ends:
            gap = task["began"] - ends[task["process"]]
            found.append(gap + task["training"] - task["began"])
        ends[task["process"]] = task["ended"]
    return found


@contextlib.contextmanager
def cluster(nodes=3):
    """Ray's test cluster: a head without CPUs, and nodes of one CPU each."""
    from ray.cluster_utils import Cluster

    found = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        yield found, [found.add_node(num_cpus=1) for _ in range(nodes)]
    finally:
        found.shutdown()


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one cell, one kill")
    options = parser.parse_args(arguments)
    more = QUICK if options.quick else []
    failures = []

    def judge(name, good, words=""):
        print(f"{name}: {'as it should be' if good else 'WRONG'}{words}", flush=True)
        if not good:
            failures.append(name)

    with tempfile.TemporaryDirectory() as name:
        root = pathlib.Path(name)
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(root / "cache"))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        assert sweep(root / "local", more).wait() == 0
        expected = contents(root / "local")
        with cluster(1 if options.quick else 3) as (ray_cluster, nodes):
            address = ray_cluster.address
            out = root / "cluster"
            status = sweep(out, more, address).wait()
            judge("three nodes", status == 0 and contents(out) == expected)
            if extra := overheads(out):
                words = f", {statistics.median(extra):.2f} s a cell beside training (median)"
                judge("overhead", statistics.median(extra) <= 1.0, words)

            out = root / "nodes"
            process = sweep(out, more, address)
            killed = 0
            for _ in range(1 if options.quick else 2):
                if wait_for_checkpoints(out, process, 2):
                    ray_cluster.remove_node(nodes.pop(0), allow_graceful=False)
                    nodes.append(ray_cluster.add_node(num_cpus=1))
                    killed += 1
            good = process.wait() == 0 and contents(out) == expected
            resumed = [task for task in tasks(out) if max(task["from_steps"]) > 0]
            words = f", {killed} nodes killed, {len(resumed)} cells went on from checkpoints"
            judge("nodes die", good and killed > 0 and bool(resumed), words)

            out = root / "driver"
            process = sweep(out, more, address)
            wait_for_checkpoints(out, process, 2)
            process.send_signal(signal.SIGKILL)
            process.wait()
            good = sweep(out, more, address).wait() == 0 and contents(out) == expected
            judge("the driver dies", good)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
