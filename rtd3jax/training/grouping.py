"""The division of the lanes of a training into groups."""

from collections.abc import Sequence
from typing import Any

from rtd3jax.envs.compat.simulated import is_simulated
from rtd3jax.training.checkpoint import Checkpoints
from rtd3jax.training.groups import Group
from rtd3jax.training.jobs import Job


def advances_alone(job: Job, strategy: str) -> bool:
    """Whether a lane is a group of its own: under ``map``, and with a simulator on the host.

    JAX cannot batch conditions and loops that call a simulator.
    """
    return strategy == "map" or is_simulated(job.program.env)


def make_groups(
    jobs: Sequence[Job],
    strategy: str,
    devices: int,
    at_once: int | None = None,
    checkpoints: Checkpoints | None = None,
) -> list[Group]:
    """Groups of one lane (``map``), or one group per program and device (``vmap``).

    Lanes with simulators also form groups of one lane under ``vmap``.

    With ``checkpoints``, only lanes that have checkpoints at a common step form a group, so a new
    lane does not make the others start from the beginning. Groups that were interrupted at
    different steps are not divided again.

    ``at_once`` limits the number of lanes in memory, under ``vmap`` for each device: groups are
    split, and a group waits until earlier groups have ended.
    """
    most = at_once or len(jobs)
    if all(advances_alone(job, strategy) for job in jobs):
        in_total = most if strategy == "map" else most * devices
        return [Group([job], wave=index // in_total) for index, job in enumerate(jobs)]
    by_executable: dict[Any, list[Job]] = {}
    for job in jobs:
        together = job if advances_alone(job, strategy) else job.executable
        by_executable.setdefault(together, []).append(job)
    steps_of = checkpoints.steps if checkpoints is not None else lambda job: set()
    shares = []
    for members in by_executable.values():
        parts = with_common_steps(members, list(map(steps_of, members)))
        width = -(-len(members) // devices)
        for part in parts:
            count = devices if len(parts) == 1 else -(-len(part) // width)
            shares += [part[start::count] for start in range(min(count, len(part)))]
    chunks = [share[k : k + most] for share in shares for k in range(0, len(share), most)]
    # Lanes that fit in memory alone need not fit together with lanes that wait.
    return [Group(chunk, wave=index // devices) for index, chunk in enumerate(chunks)]


def with_common_steps(members: Sequence[Any], steps: Sequence[set[int]]) -> list[list[Any]]:
    """Divide members into parts, so that the ``steps`` of all members of a part have one in common.

    Each part has the step that most of the remaining members have in common, and of several such
    steps the latest; the last part has the members without steps.
    """
    parts, new = [], [member for member, own in zip(members, steps, strict=True) if not own]
    left = [(member, own) for member, own in zip(members, steps, strict=True) if own]
    while left:
        each = [step for _, own in left for step in own]
        common = max(each, key=lambda step: (each.count(step), step))
        parts.append([member for member, own in left if common in own])
        left = [(member, own) for member, own in left if common not in own]
    return [*parts, new] if new else parts
