"""The networks from which the lanes of a cell start: of another run, or of a saved policy."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from rtd3jax.errors import UserError
from rtd3jax.study.cells import Cell
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import user_path
from rtd3jax.training.checkpoint_files import checkpoint_files, checkpoint_steps
from rtd3jax.training.jobs import Job
from rtd3jax.training.start import Start
from rtd3jax.training.starts import starts_of_path


def add_starts(
    directory: RunDirectory, jobs: Sequence[Job], *, write: bool, fresh: bool = False
) -> None:
    """Give each unfinished job the networks from which its lane starts, and check them.

    A lane that has checkpoints continues from them, and only needs its start if none of its
    checkpoints can be read. So for such a lane, a start that cannot be read is no error.

    Args:
        directory: the run directory of the study.
        jobs: the jobs of its lanes.
        write: whether to write, beside the file of each lane, a file that names its start.
        fresh: whether all lanes start at their first step, whatever the directory holds now.

    Raises:
        UserError: as `starts_of` does, or when a start is of another agent or has other sizes.
    """
    by_cell: dict[Cell, list[Job]] = {}
    for job in jobs:
        if not job.cell.config.start or not fresh and directory.lanes.is_done(*job.key):
            continue
        if fresh or not checkpoint_files(directory.lanes.checkpoint_directory(*job.key)):
            by_cell.setdefault(job.cell, []).append(job)
        elif job.start is None:
            job.start = _start_or_why_not(job.cell, job.seed)
    for cell, own in by_cell.items():
        new = [job for job in own if job.start is None]
        starts = starts_of(cell, [job.seed for job in new])
        for job in new:
            job.start = starts[job.seed]
            job.start.check(job.program, job.lane)
        for job in own:
            if write and job.start is not None:
                directory.lanes.write_start(cell, job.seed, job.start.about)


def _start_or_why_not(cell: Cell, seed: int) -> Start:
    try:
        return starts_of(cell, [seed])[seed]
    except UserError as error:
        return Start(cell.config.start, missing=str(error))


def check_starts_stay(cells: Iterable[Cell], out: Path) -> None:
    """Raise UserError if a cell starts from a file in ``out``, which ``--fresh`` renames."""
    for start in dict.fromkeys(cell.config.start for cell in cells if cell.config.start):
        if _place(start)[0].resolve().is_relative_to(out.resolve()):
            raise UserError(
                f"--start {start} lies in {out}, which --fresh renames: choose another --out, or "
                "rename that directory yourself and name its new path in --start"
            )


def _place(start: str) -> tuple[Path, str]:
    """The path and the disturbance ("" for any) in the field ``start`` of a configuration."""
    whole = user_path(start)
    path, mark, disturbance = start.rpartition("@")
    if whole.is_dir() or not mark or not user_path(path).is_dir():
        return whole, ""
    return user_path(path), disturbance


def starts_of(cell: Cell, seeds: Sequence[int]) -> dict[int, Start]:
    """The start of each seed; empty if the cell starts with new weights.

    Raises:
        UserError: when the file or directory in the field ``start`` cannot be read, or has no lane
            of the same agent and seed.
    """
    if not cell.config.start:
        return {}
    path, disturbance = _place(cell.config.start)
    if not path.is_dir():
        return starts_of_path(cell.config.start, tuple(seeds))
    directory = RunDirectory.open(path)
    return {seed: _start(directory, cell, seed, disturbance) for seed in seeds}


def _start(directory: RunDirectory, cell: Cell, seed: int, disturbance: str) -> Start:
    config, path = cell.config, directory.path
    fitting = [
        other
        for other in directory.cells
        if (other.config.algorithm, other.config.memory) == (config.algorithm, config.memory)
        and disturbance in ("", other.disturbance)
    ]
    same_length = [c for c in fitting if c.config.history_length == config.history_length]
    fitting = same_length or fitting
    fitting = [c for c in fitting if c.env == cell.env] or fitting
    wanted = f"{config.algorithm}{f' under {disturbance}' if disturbance else ''}"
    if not fitting:
        there = dict.fromkeys(
            f"{c.config.algorithm} under {c.disturbance}" for c in directory.cells
        )
        raise UserError(f"{path} has no {wanted} to start from, only {', '.join(there)}")
    if len(fitting) > 1:
        names = dict.fromkeys(f"{path}@{other.disturbance}" for other in fitting)
        if len(names) == 1:
            raise UserError(
                f"{len(fitting)} cells of {path} fit {wanted}: they differ in environment or "
                "history_length, and none has those of the new training; save the policy that you "
                "want (rtd.load_policy(...).save) and start from its file"
            )
        raise UserError(
            f"{len(fitting)} cells of {path} fit {wanted}; say which disturbance: "
            f"{' or '.join(names)}"
        )
    (other,) = fitting
    if seed not in directory.seeds:
        raise UserError(f"{path} has no seed {seed} to start from; its seeds are {directory.seeds}")
    where = f"{path} {other.env} {other.disturbance}"
    place = directory.lanes.checkpoint_directory(other, seed)
    steps = checkpoint_steps(place)
    # A sweep that was killed may leave a checkpoint of an earlier step beside the trained policy.
    if directory.lanes.is_done(other, seed) and steps and steps[0] >= other.config.total_steps:
        return Start(where, checkpoint=checkpoint_files(place)[0])
    return Start(where, policy=directory.lanes.policy(other, seed))
