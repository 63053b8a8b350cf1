"""The log of a study: a JSON row for each evaluation of each lane, written during training."""

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rtd3jax.study.results import CELL

LOG = "log.jsonl"
TASKS = "cluster.jsonl"
"""File with a JSON line for each task of a cluster that ended without an error: cell, seeds, node
and times, and the step from which each lane continued."""


def append_rows(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """Append rows in a single write, so that rows of other processes are not mixed with them."""
    if lines := "".join(json.dumps(row) + "\n" for row in rows):
        data = lines.encode()
        with path.open("ab", buffering=0) as log:
            written = log.write(data)
            while written < len(data):  # on a disk that is nearly full; the next write raises
                written += log.write(data[written:])


def repair_log(path: Path) -> None:
    """End an incomplete last line, which a killed process has left."""
    if not path.exists() or path.stat().st_size == 0:
        return
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        ended = file.read() == b"\n"
    if not ended:
        with path.open("a", encoding="utf-8") as file:
            file.write("\n")


class LoggedReturns:
    """The returns in a log that grows, each line of which is read once."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self._returns: dict[tuple[Any, ...], Any] = {}

    def update(self) -> dict[tuple[Any, ...], Any]:
        """Repair the log; return the last return by lane and step, as the log has them now.

        A key is the lane as in `lane_of`, followed by the step.
        """
        repair_log(self._path)
        if self._path.exists():
            with self._path.open("rb") as file:
                file.seek(self._offset)
                new = file.read()
            new = new[: new.rfind(b"\n") + 1]
            self._offset += len(new)
            for row in parse_log(new.decode("utf-8", "replace")):
                self._returns[*lane_of(row), row["step"]] = row.get("return")
        return self._returns


def read_log(path: Path) -> list[dict[str, Any]]:
    """Rows of a log, without the incomplete line of a killed process."""
    return parse_log(path.read_text("utf-8", "replace")) if path.exists() else []


def parse_log(text: str) -> list[dict[str, Any]]:
    """Rows of a part of a log; see `read_log`."""
    rows = []
    for line in text.splitlines():
        try:
            row = json.loads(line)
            if isinstance(row["step"], int) and lane_of(row):
                rows.append(row)
        except (ValueError, KeyError, TypeError):
            continue
    return rows


def lane_of(row: dict[str, Any]) -> tuple[Any, ...]:
    """The lane of a row: the key of its cell and its seed."""
    return tuple(row[name] for name in (*CELL, "seed"))


def steps_reached(rows: Iterable[dict[str, Any]]) -> dict[tuple[Any, ...], int]:
    """The step of the last row of each lane: a lane that is trained again is logged again."""
    return {lane_of(row): row["step"] for row in rows}
