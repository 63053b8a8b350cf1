"""The state of a study, from the files of its lanes, its log and its lock."""

from typing import Any

from rtd3jax.errors import UserError
from rtd3jax.study.cells import Cell
from rtd3jax.study.lane_files import LaneFiles
from rtd3jax.study.lock import is_held
from rtd3jax.study.log import LOG, lane_of, read_log, steps_reached
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import read_arrays
from rtd3jax.training.checkpoint_files import checkpoint_steps


def ledger(directory: RunDirectory) -> list[dict[str, Any]]:
    """A row for each lane: the key of its cell, ``seed``, ``status``, ``step`` and ``reason``.

    The status is done, lost, failed, running, interrupted (at a step), or planned. It is not
    stored: it is derived from the files of the lanes, the log and the lock, so it always agrees
    with them.
    """
    begun = "running" if is_held(directory.path) else "interrupted"
    logged = steps_reached(read_log(directory.path / LOG))
    return [
        {**cell.key, "seed": seed, **_lane_status(directory.lanes, cell, seed, begun, logged)}
        for cell in directory.cells
        for seed in directory.seeds
    ]


def _lane_status(
    lanes: LaneFiles, cell: Cell, seed: int, begun: str, logged: dict[Any, int]
) -> dict[str, Any]:
    if lanes.is_done(cell, seed):
        try:
            _, metadata = read_arrays(lanes.lane_path(cell, seed))
        except UserError as error:  # one damaged file does not hide the others
            return {"status": "failed", "step": 0, "reason": str(error)}
        failure = metadata["failure"]
        if failure is not None:
            return {"status": "lost", "step": failure["step"], "reason": failure["reason"]}
        return {"status": "done", "step": cell.config.total_steps, "reason": ""}
    steps = checkpoint_steps(lanes.checkpoint_directory(cell, seed))
    kept = max(steps, default=0)
    if (reason := lanes.error(cell, seed)) is not None:
        return {"status": "failed", "step": kept, "reason": reason}
    reached = logged.get(lane_of({**cell.key, "seed": seed}), 0)
    # If the log reaches the end but there is no file, the file was removed to train again.
    reached = max(kept, reached if reached < cell.config.total_steps else 0)
    later = f"next start at step {kept:,}" if reached and begun != "running" else ""
    return {"status": begun if reached else "planned", "step": reached, "reason": later}
