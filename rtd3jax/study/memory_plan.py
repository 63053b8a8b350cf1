"""Estimates the memory of lanes before allocation, and how many lanes fit together."""

import weakref
from collections.abc import Sequence
from typing import Any

import jax

from rtd3jax.agents.agent import count_parameters
from rtd3jax.config import Config
from rtd3jax.errors import UserError
from rtd3jax.registries import AGENTS
from rtd3jax.system.machine import memory_limit
from rtd3jax.training.devices import workers
from rtd3jax.training.jobs import Job

_GRADIENTS = 1.3
"""Number of temporary copies of all parameters."""

_ACTING = 8
"""Number of temporary arrays of [l + 1, E, H] in an evaluation of E episodes."""

_PRESENT_STEPS = 22
"""Number of temporary arrays of [B, H] for the step of the memory at each transition."""

_HEADROOM = 0.8
"""Fraction of the memory for lanes; the rest is for programs and tables."""


PROCESS_BYTES = 1_150 * 2**20
"""Bytes of a process without lanes: Python, JAX, compiled programs, tables and figures."""

WORKER_BYTES = 700 * 2**20
"""Bytes of a process that only trains, without lanes: Python, JAX and compiled programs."""


_MEASURED: weakref.WeakKeyDictionary[Job, tuple[int, int]] = weakref.WeakKeyDictionary()
"""The bytes of lanes: several parts of a plan ask for the same lane, and each answer traces it.

The references are weak, because a lane can hold a recording.
"""


def state_bytes(job: Job) -> int:
    """Bytes of a lane: its state and its environment's parameters, such as a recording.

    The state has parameters, optimisers, replay, carries and the environment's state. Under
    ``map``, lanes on one device share the environment's parameters, but each lane counts them here.
    """

    def size(leaf: jax.Array | jax.ShapeDtypeStruct) -> int:
        key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return leaf.size * (8 if key else leaf.dtype.itemsize)

    state = jax.eval_shape(job.program.init, job.lane)
    return sum(map(size, jax.tree.leaves((state, job.lane.env_params))))


def working_bytes(config: Config, observation_size: int, action_size: int) -> int:
    """Temporary bytes of a lane that advances: activations and gradients."""
    row = 4 * config.hidden_size
    array = (config.window_tokens + 1) * row
    counts = count_parameters(
        config.algorithm, observation_size, action_size, config.hidden_size, config.memory
    )
    gradients = 4 * (counts["actor"] + 2 * counts["critic"])
    activations = AGENTS[config.algorithm].peak_arrays * array * config.batch_size
    if config.replay == "segments":
        length = config.segment_steps
        tokens = (config.window_tokens + length) * (config.batch_size // length)
        activations = AGENTS[config.algorithm].peak_arrays * tokens * row
        activations += _PRESENT_STEPS * config.batch_size * row
    acting = row if config.has_running_carry else array
    update = activations + _GRADIENTS * gradients
    return int(max(update, _ACTING * acting * config.eval_episodes))


def job_bytes(jobs: Sequence[Job]) -> dict[Any, tuple[int, int]]:
    """State bytes and temporary bytes of a lane, by `Job.executable`."""
    examples = {job.executable: job for job in jobs}
    return {executable: _lane_bytes(job) for executable, job in examples.items()}


def _lane_bytes(job: Job) -> tuple[int, int]:
    """State bytes and temporary bytes of a lane."""
    if job not in _MEASURED:
        program = job.program
        actions = program.bounds(job.lane).low.shape[0]
        work = working_bytes(program.config, program.observation_size, actions)
        _MEASURED[job] = state_bytes(job), work
    return _MEASURED[job]


def _largest(jobs: Sequence[Job]) -> tuple[int, int]:
    """The largest state bytes, and the largest temporary bytes, of the lanes."""
    states, works = zip(*job_bytes(jobs).values(), strict=True)
    return max(states), max(works)


def lanes_at_once(jobs: Sequence[Job], strategy: str, workers: int, memory: int) -> int:
    """Number of lanes that fit in ``memory`` bytes: per device (``vmap``), or in total (``map``).

    Under ``vmap``, all lanes of a device advance together. Under ``map``, one lane per worker
    advances, and the other lanes only need memory for their states.

    Raises:
        UserError: when not even one lane fits.
    """
    state, work = _largest(jobs)
    usable = int(_HEADROOM * memory)
    if strategy == "vmap":
        fit = usable // (state + work)
    else:
        # One more lane, because the next wave begins while the last lane of a wave is trained.
        busy = min(workers, max(1, usable // (state + work)))
        fit = (usable - busy * work) // state - (workers - 1)
    if fit < 1 and state + work > usable:
        raise UserError(
            f"one lane needs {(state + work) / 2**30:,.1f} GiB, but only {usable / 2**30:,.1f} of "
            f"{memory / 2**30:,.1f} GiB may be used; lower replay_capacity, hidden_size, "
            "batch_size or history_length"
        )
    return max(1, fit)


def lanes_in_total(at_once: int, strategy: str, devices: int) -> int:
    """Number of lanes that fit on all devices, from the result of `lanes_at_once`."""
    return at_once * (devices if strategy == "vmap" else 1)


def processes_bytes(jobs: Sequence[Job], processes: int, lanes: int) -> int:
    """Bytes of a study whose lanes are trained by processes besides the one that plans.

    Args:
        jobs: the lanes of the study.
        processes: number of processes that train.
        lanes: number of lanes that each of them trains at a time.
    """
    state, work = _largest(jobs)
    return PROCESS_BYTES + processes * (WORKER_BYTES + lanes * (state + work))


def usable_memory() -> int:
    """Bytes of the device's memory, or of the machine's memory that this process may use.

    The latter is reduced, so that the fraction for lanes leaves space for the process itself.
    """
    limit = (workers()[0].memory_stats() or {}).get("bytes_limit")
    if limit:
        return limit
    own = memory_limit()
    return max(0, min(own, int((own - PROCESS_BYTES) / _HEADROOM)))
