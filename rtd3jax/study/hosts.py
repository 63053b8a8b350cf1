"""The processes of one job under `jax.distributed`, and which lanes are whose.

Lanes do not talk to each other, so nothing is exchanged while they are trained: each device of the
job gets every D-th lane, a process trains those of its own devices and writes their files, and the
last to end writes the tables of all. A lane's numbers are the same on whichever device trains it.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import jax

from rtd3jax.errors import UserError
from rtd3jax.study import launch
from rtd3jax.training.lanes import Job


def relaunch(command: str, arguments: Sequence[str] | None) -> NoReturn:
    """Become a process that has joined its job, and run the command again there.

    Args:
        command: the module whose ``main`` is run.
        arguments: that were given to it from Python; None where it was run as a command.

    Raises:
        UserError: when the command was called from Python, where no process may be replaced.
    """
    if arguments is not None:
        raise UserError(
            "--distributed is for the command; from Python, call jax.distributed.initialize() "
            "before anything imports gymnax"
        )
    package = str(Path(__file__).parents[2])
    path = os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH"))))
    sys.stdout.flush()
    # -P: the file's own directory holds modules of the package, which must not stand alone.
    line = [sys.executable, "-P", launch.__file__, command, *sys.argv[1:]]
    os.execve(sys.executable, line, {**os.environ, "PYTHONPATH": path})


def own_share(jobs: Sequence[Job]) -> list[Job]:
    """The lanes of this process's devices: every D-th for each of the job's D devices."""
    devices = jax.devices()
    own = {index for index, d in enumerate(devices) if d.process_index == jax.process_index()}
    return [job for index, job in enumerate(jobs) if index % len(devices) in own]


def own_shard() -> tuple[int, int]:
    """This process among those of the job, as a shard: (1, 4) is the first of four."""
    return jax.process_index() + 1, jax.process_count()
