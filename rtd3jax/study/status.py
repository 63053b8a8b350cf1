"""How far a study is, read from its lanes' files, its log and its lock."""

from typing import Any

from rtd3jax.study.lane_files import LaneFiles
from rtd3jax.study.lock import is_held
from rtd3jax.study.log import LOG, lane_of, read_log, steps_reached
from rtd3jax.study.plan import Cell
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import read_arrays
from rtd3jax.training.checkpoint import checkpoint_steps


def ledger(directory: RunDirectory) -> list[dict[str, Any]]:
    """Each lane's state: done, lost, failed, running, interrupted (at a step), or planned.

    Nothing is kept for it: it is read from the lanes' files, the log and the lock, so that it
    cannot disagree with them.
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
        failure = read_arrays(lanes.lane_path(cell, seed))[1]["failure"]
        if failure is not None:
            return {"status": "lost", "step": failure["step"], "reason": failure["reason"]}
        return {"status": "done", "step": cell.config.total_steps, "reason": ""}
    if lanes.error_path(cell, seed).exists():
        reason = lanes.error_path(cell, seed).read_text("utf-8").strip()
        return {"status": "failed", "step": 0, "reason": reason}
    steps = checkpoint_steps(lanes.checkpoint_directory(cell, seed))
    kept = max(steps, default=0)
    reached = logged.get(lane_of({**cell.key, "seed": seed}), 0)
    # A lane that is logged to its end but has no file was removed, to be trained again.
    reached = max(kept, reached if reached < cell.config.total_steps else 0)
    reason = f"next start at step {kept:,}" if reached and begun != "running" else ""
    return {"status": begun if reached else "planned", "step": reached, "reason": reason}
