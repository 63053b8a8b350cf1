"""Follows the log of a study that other processes write."""

from typing import Any

from rtd3jax.study.log import LOG, lane_of, parse_log, steps_reached
from rtd3jax.study.loggers import Logger
from rtd3jax.study.rundir import RunDirectory


class LogReader:
    """Reads the log that other processes write: the steps so far, and new rows for the trackers.

    Args:
        directory: the run directory.
        logger: the trackers, which get each row that is written from now on; None without trackers.
    """

    def __init__(self, directory: RunDirectory, logger: Logger | None) -> None:
        self._path = directory.path / LOG
        self._cells = {tuple(cell.key.values()): cell for cell in directory.cells}
        self._logger = logger
        self._reached: dict[tuple[Any, ...], int] = {}
        self._offset = 0
        self._new_rows()  # the trackers have these rows already

    def steps(self) -> int:
        """The sum of all lanes' steps, each at its last evaluation."""
        for row in self._new_rows():
            if self._logger is not None:
                self._logger.log(self._cells[lane_of(row)[:-1]], row["seed"], row)
        return sum(self._reached.values())

    def _new_rows(self) -> list[dict[str, Any]]:
        """The new rows of the study's lanes: lines that were completed since the last call."""
        if not self._path.exists():
            return []
        with self._path.open("rb") as file:
            file.seek(self._offset)
            text = file.read()
        text = text[: text.rfind(b"\n") + 1]
        self._offset += len(text)
        rows = [
            row
            for row in parse_log(text.decode("utf-8", "replace"))
            if lane_of(row)[:-1] in self._cells
        ]
        for lane, step in steps_reached(rows).items():
            self._reached[lane] = max(step, self._reached.get(lane, 0))
        return rows
