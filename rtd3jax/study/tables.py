"""The tables of a study, from the files of its lanes."""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import pandas as pd

from rtd3jax.errors import UserError
from rtd3jax.study.cells import Cell
from rtd3jax.study.lane_files import LaneFiles
from rtd3jax.study.results import CELL, CURVES, EPISODES, METRICS, frame, read_table
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import read_arrays

SCHEMAS = {"curves": CURVES, "episodes": EPISODES, "metrics": METRICS}
"""The tables of a run directory; ``curves.parquet`` has the schema CURVES."""

_CURVE_ARRAYS = ("steps", "returns", "true_returns")
_FINAL_ARRAYS = ("final_returns", "final_true_returns")


@dataclasses.dataclass(frozen=True)
class Rows:
    """Rows of the tables, and a row for each lane that was lost or could not be trained."""

    curves: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    episodes: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    metrics: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    failures: list[dict[str, Any]] = dataclasses.field(default_factory=list)

    def add(self, lanes: LaneFiles, cell: Cell, seed: int) -> None:
        """Add the rows of a lane; there are none if it has not ended.

        Raises:
            UserError: when the file of the lane is damaged.
        """
        row = {**cell.key, "seed": seed}
        if not lanes.is_done(cell, seed):
            if (reason := lanes.error(cell, seed)) is not None:
                self.failures.append({**row, "step": "?", "reason": f"failed: {reason}"})
            return
        path = lanes.lane_path(cell, seed)
        try:
            arrays, metadata = read_arrays(path)
            failure = metadata["failure"]
            points = zip(*(arrays[f"results.{n}"] for n in _CURVE_ARRAYS), strict=True)
            finals = zip(*(arrays[f"results.{n}"] for n in _FINAL_ARRAYS), strict=True)
            curves = [
                {**row, "step": int(step), "return": value, "true_return": true}
                for step, value, true in points
            ]
            episodes = [
                {**row, "episode": episode, "return": value, "true_return": true}
                for episode, (value, true) in enumerate(finals)
            ]
            metrics = [
                {**row, "step": int(step), "metric": name.removeprefix("metrics."), "value": value}
                for name in sorted(arrays)
                if name.startswith("metrics.")
                for step, value in zip(arrays["results.steps"], arrays[name], strict=True)
            ]
        except (UserError, KeyError, ValueError, TypeError) as error:
            raise UserError(
                f"{error}: remove {path} and repeat the command to train this lane again"
            ) from error
        self.curves.extend(curves)
        self.episodes.extend(episodes)
        self.metrics.extend(metrics)
        if failure is not None:
            self.failures.append({**row, **failure})


def rows_of_lanes(directory: RunDirectory) -> Rows:
    """The rows of all lanes that have ended.

    Raises:
        UserError: when the file of a lane is damaged.
    """
    rows = Rows()
    for cell in directory.cells:
        for seed in directory.seeds:
            rows.add(directory.lanes, cell, seed)
    return rows


def current_tables(
    directory: RunDirectory, notes: list[str] | None = None
) -> dict[str, pd.DataFrame]:
    """The tables `SCHEMAS` of all lanes that have ended; without any lane they are empty.

    The rows are those of the Parquet files, and those of the lanes that ended after the files were
    written, because a sweep that is killed does not write its tables. Rows of a lane that is to be
    trained to more steps, and of one whose file was removed to train it again, are left out, as
    `rows_of_lanes` does. Nothing is written.

    Args:
        directory: the run directory.
        notes: gets a line for each file that cannot be read, which is then left out.

    Raises:
        UserError: when the file of a table or of a later lane is damaged, without ``notes``.
    """
    tables = {}
    for name, schema in SCHEMAS.items():
        tables[name] = frame([], schema)
        path = directory.path / f"{name}.parquet"
        with _noted(notes):
            if path.exists():
                tables[name] = read_table(path, schema)
    rows, replaced = Rows(), _replaced_lanes(directory, tables)
    for cell, seed in replaced:
        with _noted(notes):
            rows.add(directory.lanes, cell, seed)
    if not replaced:
        return tables
    lanes = [(*cell.key.values(), seed) for cell, seed in replaced]
    found = {}
    for name, table in tables.items():
        stays = ~pd.MultiIndex.from_frame(table[[*CELL, "seed"]]).isin(lanes)
        new = frame(vars(rows)[name], SCHEMAS[name])
        found[name] = pd.concat([table[stays], new], ignore_index=True)
    return found


def _replaced_lanes(
    directory: RunDirectory, tables: dict[str, pd.DataFrame]
) -> list[tuple[Cell, int]]:
    """The lanes whose rows in the tables are not those of their files.

    The file of such a lane is not in the tables, is newer than these, has too few steps, or was
    removed. A file is newer if the lane was trained further, or again. It has too few steps if the
    study was extended and the lane has not been trained further yet.
    """
    written = min(_written(directory, name) for name in SCHEMAS)
    # A sweep that is killed between two tables leaves some of them without its latest lanes.
    there = set.intersection(*map(_lanes_of, tables.values()))
    partly = set.union(*map(_lanes_of, tables.values()))
    # A copy of the tables alone has no file of any lane.
    has_files = (directory.path / "lanes").is_dir()
    found = []
    for cell in directory.cells:
        for seed in directory.seeds:
            path, lane = directory.lanes.lane_path(cell, seed), (*cell.key.values(), seed)
            if path.exists():
                replaced = (
                    lane not in there
                    or path.stat().st_mtime_ns >= written
                    or not directory.lanes.is_done(cell, seed)
                )
            else:
                replaced = has_files and lane in partly
            if replaced:
                found.append((cell, seed))
    return found


def _written(directory: RunDirectory, name: str) -> int:
    """When a table was written, in nanoseconds; 0 without the table."""
    path = directory.path / f"{name}.parquet"
    return path.stat().st_mtime_ns if path.exists() else 0


def _lanes_of(table: pd.DataFrame) -> set[tuple[Any, ...]]:
    return set(table[[*CELL, "seed"]].drop_duplicates().itertuples(False, None))


@contextlib.contextmanager
def _noted(notes: list[str] | None) -> Iterator[None]:
    """Turn a UserError into a line of ``notes``, if there are notes."""
    try:
        yield
    except UserError as error:
        if notes is None:
            raise
        notes.append(str(error))
