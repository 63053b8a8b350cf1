"""Kills a sweep at random times, resumes it, and compares it with an uninterrupted sweep.

Usage: python experiments/reliability/kill_and_resume.py [--quick] [--trials N]

A trial starts the sweep in a new directory, and kills it with SIGKILL at a random time (in two of
three trials, it is started and killed again). Then the same command finishes the sweep, and every
table and every lane's file is compared byte by byte. The exit status is 1 if a file differs.
"""

import argparse
import os
import pathlib
import random
import subprocess
import sys
import tempfile
import time

STUDY = [
    *("--env", "rover", "--disturbances", "ar1-slip", "--history-lengths", "2"),
    *("--algorithms", "td3", "h-td3", "--seeds", "2", "--total-steps", "6000"),
    *("--hidden-size", "16", "--batch-size", "16", "--learning-starts", "100"),
    *("--eval-every", "500", "--eval-episodes", "2", "--final-episodes", "3"),
    *("--checkpoint-every", "100steps", "--quiet", "--no-report"),
]


QUICK = ["--total-steps", "1500"]


def command(out: pathlib.Path, more: list[str]) -> list[str]:
    return [sys.executable, "-m", "rtd3jax.sweep", *STUDY, *more, "--out", str(out)]


def run(
    out: pathlib.Path,
    environment: dict[str, str],
    more: list[str],
    kill_after: float | None = None,
) -> bool:
    """Run the sweep; return whether it was killed."""
    with subprocess.Popen(
        command(out, more),
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    ) as process:
        try:
            _, errors = process.communicate(timeout=kill_after)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            return True
    if process.returncode != 0:
        raise SystemExit(f"the sweep failed: {errors.decode()[-2000:]}")
    return False


def contents(out: pathlib.Path) -> dict[str, bytes]:
    files = [*out.glob("*.parquet"), out / "summary.md", *out.rglob("lanes/**/*.safetensors")]
    return {str(file.relative_to(out)): file.read_bytes() for file in files}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="1 trial")
    parser.add_argument("--trials", type=int, default=50)
    options = parser.parse_args(arguments)
    trials, more = (1, QUICK) if options.quick else (options.trials, [])
    chance = random.Random(0)
    with tempfile.TemporaryDirectory() as name:
        root = pathlib.Path(name)
        environment = {
            "JAX_COMPILATION_CACHE_DIR": str(root / "cache"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            **os.environ,
        }
        if not options.quick:  # so that `life` does not include compilation
            run(root / "warm", environment, more)
        began = time.perf_counter()
        run(root / "whole", environment, more)
        life = time.perf_counter() - began
        expected = contents(root / "whole")
        same = kills = 0
        for trial in range(trials):
            out = root / f"trial-{trial}"
            for _ in range(chance.choice((1, 2, 2))):
                kills += run(out, environment, more, kill_after=chance.uniform(0.3, 1.0) * life)
            run(out, environment, more)
            same += contents(out) == expected
            print(f"{same} of {trial + 1} bit-identical after {kills} kills", flush=True)
    return 0 if same == trials else 1


if __name__ == "__main__":
    sys.exit(main())
