"""The plan of a sweep as text, with an estimate of its memory and time."""

import dataclasses
from collections.abc import Callable, Sequence

from rtd3jax.study.cells import Cell
from rtd3jax.study.flops import update_flops
from rtd3jax.study.memory_plan import job_bytes, lanes_at_once, lanes_in_total
from rtd3jax.study.time_estimate import study_seconds
from rtd3jax.training.devices import workers
from rtd3jax.training.jobs import Job


@dataclasses.dataclass(frozen=True)
class Cost:
    """The estimated memory and time of a sweep.

    Attributes:
        programs: number of programs to compile.
        state_bytes: bytes of the state of the largest lane.
        working_bytes: temporary bytes of the largest lane while it advances.
        seconds: time without compilation; see `rtd3jax.study.time_estimate`.
    """

    programs: int
    state_bytes: int
    working_bytes: int
    seconds: float


def estimate(
    jobs: Sequence[Job],
    strategy: str,
    at_once: int,
    say: Callable[[str], None] = lambda line: None,
) -> Cost:
    """Count programs and bytes, and time some programs; ``say`` receives lines of progress.

    ``at_once`` is the number of lanes that fit in memory, as in `study_seconds`.
    """
    sizes = job_bytes(jobs)
    state, work = (max(column) for column in zip(*sizes.values(), strict=True))
    return Cost(len(sizes), state, work, study_seconds(jobs, strategy, update_flops, say, at_once))


def plan_text(
    cells: Sequence[Cell],
    seeds: Sequence[int],
    jobs: Sequence[Job],
    strategy: str,
    memory: int,
    say: Callable[[str], None] = lambda line: None,
) -> str:
    """The plan of a sweep as text, with memory and time; ``memory`` is in bytes."""
    count = len(workers())
    fit = lanes_at_once(jobs, strategy, count, memory)  # before a lane is allocated and timed
    cost = estimate(jobs, strategy, fit, say)
    in_total = lanes_in_total(fit, strategy, count)
    waits = f"; the other {len(jobs) - in_total:,} wait" if in_total < len(jobs) else ""
    whole = len(cells) * len(seeds)
    left = f", of which {len(jobs)} are left" if len(jobs) < whole else ""
    lines = [f"{len(cells)} cells × {len(seeds)} seeds = {whole} lanes{left}"]
    for cell in cells:
        config = cell.config
        lines.append(
            f"  {cell.env:10} {cell.disturbance:24} {config.algorithm:20} "
            f"l={config.history_length:<3} {config.total_steps:,} steps"
        )
    lines += [
        f"programs to compile: {cost.programs}",
        f"memory of the largest lane: {cost.state_bytes / 2**20:,.1f} MiB of state "
        "(parameters, optimisers, replay, carries, recordings), and "
        f"{cost.working_bytes / 2**20:,.1f} MiB while it advances (activations, gradients)",
        f"lanes that fit in {memory / 2**30:,.1f} GiB"
        f"{' of a device' if strategy == 'vmap' else ''}: {min(fit, len(jobs)):,}{waits}",
        f"time: about {_duration(cost.seconds)} on {count} "
        f"{'cores' if workers()[0].platform == 'cpu' else 'devices'}, "
        "measured just now, without compilation",
    ]
    return "\n".join(lines)


def _duration(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds > 5400 else f"{seconds / 60:.1f} min"
