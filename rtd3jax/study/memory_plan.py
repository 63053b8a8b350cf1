"""What lanes need in memory, before anything is allocated, and how many fit at once."""

from collections.abc import Sequence
from typing import Any

import jax

from rtd3jax.agents.agent import count_parameters
from rtd3jax.config import Config
from rtd3jax.errors import UserError
from rtd3jax.registries import AGENTS
from rtd3jax.system.machine import memory_limit
from rtd3jax.training.lanes import Job, workers

_GRADIENTS = 1.3
"""Copies of all parameters that are alive beside them."""

_ACTING = 8
"""Arrays of [l + 1, E, H] that are alive while E episodes are evaluated side by side."""

_PRESENT_STEPS = 22
"""Arrays of [B, H] alive beside a segment's: one step of the memory for each transition."""

_HEADROOM = 0.8
"""Share of the memory that lanes may take: programs, tables and the rest need some too."""


PROCESS_BYTES = 1_150 * 2**20
"""Of a process before it has a lane: Python, JAX, its compiled programs, tables and pictures."""


def state_bytes(job: Job) -> int:
    """Bytes that a lane keeps: parameters, optimisers, replay, carries, environment; exact."""

    def size(leaf: jax.Array | jax.ShapeDtypeStruct) -> int:
        key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return leaf.size * (8 if key else leaf.dtype.itemsize)

    return sum(map(size, jax.tree.leaves(jax.eval_shape(job.program.init, job.lane))))


def working_bytes(config: Config, observation_size: int, action_size: int) -> int:
    """Bytes that a lane needs beside its state while it advances: activations and gradients."""
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
    acting = row if config.runs_on else array
    update = activations + _GRADIENTS * gradients
    return int(max(update, _ACTING * acting * config.eval_episodes))


def job_bytes(jobs: Sequence[Job]) -> dict[Any, tuple[int, int]]:
    """State and working bytes of a lane, by program."""
    examples = {job.program: job for job in jobs}
    return {
        program: (
            state_bytes(job),
            working_bytes(
                program.config,
                program.observation_size,
                job.program.bounds(job.lane).low.shape[0],
            ),
        )
        for program, job in examples.items()
    }


def lanes_at_once(jobs: Sequence[Job], strategy: str, workers: int, memory: int) -> int:
    """How many lanes fit in ``memory`` bytes: of a device under ``vmap``, of the machine else.

    Under ``vmap`` all lanes of a device advance together; else as many as there are workers do, and
    the others only keep their state.

    Raises:
        UserError: when not even one fits.
    """
    state, work = (max(sizes) for sizes in zip(*job_bytes(jobs).values(), strict=True))
    usable = int(_HEADROOM * memory)
    if strategy == "vmap":
        fit = usable // (state + work)
    else:
        # A lane more than are meant to be: while a wave's last lane is trained, the next begins.
        busy = min(workers, max(1, usable // (state + work)))
        fit = (usable - busy * work) // state - (workers - 1)
    if fit < 1 and state + work > usable:
        raise UserError(
            f"one lane needs {(state + work) / 2**30:,.1f} GiB and {usable / 2**30:,.1f} of the "
            f"{memory / 2**30:,.1f} there are may be used; lower replay_capacity, hidden_size, "
            "batch_size or history_length"
        )
    return max(1, fit)


def usable_memory() -> int:
    """Bytes of the device's own memory, or of what this process may use of the machine's.

    Of the latter so much that the share of it that lanes may take leaves room for the process.
    """
    limit = (workers()[0].memory_stats() or {}).get("bytes_limit")
    if limit:
        return limit
    own = memory_limit()
    return max(0, min(own, int((own - PROCESS_BYTES) / _HEADROOM)))
