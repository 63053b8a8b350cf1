"""Joins a job of several processes, then runs a command: ``python launch.py MODULE ARGUMENTS``.

A process can only join a job before JAX uses a device, and the import of gymnax uses one. So this
file is run by its path, in its own process, and imports the package last. `rtd3jax.study.hosts`
starts it.
"""

import importlib
import os
import sys

import jax

FOREVER = 10 * 365 * 24 * 3600
"""Seconds for which a process that has ended waits for the others before it leaves the job."""


def number(name: str) -> int | None:
    """An environment variable as a number; None if it is not set."""
    return int(os.environ[name]) if os.environ.get(name) else None


def main() -> int:
    """Join the job, run the module's ``main``, and return its exit status."""
    try:
        jax.distributed.initialize(
            num_processes=number("JAX_NUM_PROCESSES"),
            process_id=number("JAX_PROCESS_ID"),
            shutdown_timeout_seconds=FOREVER,
        )
    except (ValueError, TypeError, RuntimeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        print(
            f"error: --distributed: {reason} Start the processes with srun or mpirun, or set "
            "JAX_COORDINATOR_ADDRESS (host:port of the first), JAX_NUM_PROCESSES and "
            "JAX_PROCESS_ID (0, 1, ...) for each",
            file=sys.stderr,
        )
        return 2
    return importlib.import_module(sys.argv[1]).main(sys.argv[2:])


if __name__ == "__main__":
    sys.exit(main())
