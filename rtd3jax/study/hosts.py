"""Divides the lanes among the processes of a job under `jax.distributed`.

Lanes are independent, so the processes exchange nothing during training. Each of the D devices of
the job gets every D-th lane. A process trains the lanes of its own devices and writes their files;
the process that ends last writes the tables of all lanes. The results of a lane do not depend on
which device trains it, if the devices are equal and, on CPUs, each process may use the same number
of cores; otherwise they differ by rounding.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import jax

from rtd3jax.errors import UserError
from rtd3jax.study import launch
from rtd3jax.training.jobs import Job


def relaunch(command: str, arguments: Sequence[str] | None) -> NoReturn:
    """Replace this process by one that joins the job and runs the command again.

    Args:
        command: the module whose ``main`` is run.
        arguments: the arguments of a call from Python; None for a command in a shell.

    Raises:
        UserError: when the command was called from Python, whose process must not be replaced.
    """
    if arguments is not None:
        raise UserError(
            "--distributed only works in a shell; in Python, call jax.distributed.initialize() "
            "before gymnax is imported"
        )
    package = str(Path(__file__).parents[2])
    path = os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH"))))
    sys.stdout.flush()
    # -P: the directory of the file must not be on the path, as it holds modules of the package.
    line = [sys.executable, "-P", launch.__file__, command, *sys.argv[1:]]
    os.execve(sys.executable, line, {**os.environ, "PYTHONPATH": path})


def own_share(jobs: Sequence[Job]) -> list[Job]:
    """The lanes of this process's devices: each of the job's D devices has every D-th lane."""
    devices = jax.devices()
    own = {index for index, d in enumerate(devices) if d.process_index == jax.process_index()}
    return [job for index, job in enumerate(jobs) if index % len(devices) in own]


def own_shard() -> tuple[int, int]:
    """The shard of this process among the processes of the job: (1, 4) is the first of four."""
    return jax.process_index() + 1, jax.process_count()
