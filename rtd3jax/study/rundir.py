"""A run directory: what study is in it, and how that may grow.

Beside the configuration, which is here, it holds a file for each lane (`lane_files`), the log
(`log`) and what is derived from the lanes (`derive`).
"""

import json
import platform
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rtd3jax.envs.interface import describe
from rtd3jax.errors import UserError
from rtd3jax.policies.trained import FORMAT
from rtd3jax.study.contents import (
    Contents,
    cell_words,
    grown,
    longer_cells,
    read_config,
    what_was_added,
)
from rtd3jax.study.lane_files import LaneFiles, cell_name
from rtd3jax.study.lock import writer
from rtd3jax.study.plan import Cell
from rtd3jax.system.files import (
    user_path,
    write_bytes_atomically,
)
from rtd3jax.system.versions import versions_of
from rtd3jax.training.checkpoint import checkpoint_steps, why_not_longer
from rtd3jax.training.lanes import Job

CONFIG = "config.json"
_PATIENCE, _PATIENCE_SECONDS = 10, 0.1
"""How often, and how long, a shard waits for another one that lets the study grow."""
PACKAGES = ("rtd3jax", "jax", "jaxlib", "flax", "optax", "gymnax", "numpy")


class RunDirectory:
    """The directory of one sweep.

    What is there already is gone on with, and grows by what is asked for besides.

    Raises:
        UserError: when a lane that is there would become another one, or when the directory cannot
            be written.
    """

    def __init__(
        self,
        path: str | Path,
        cells: Sequence[Cell],
        seeds: Sequence[int],
        episodes: int,
        *,
        prepare: bool = True,
    ):
        self.path = user_path(path)
        self.lanes = LaneFiles(self.path)
        self._asked = self.contents = Contents(tuple(cells), tuple(seeds), episodes)
        if prepare:
            self.prepare()

    @classmethod
    def open(cls, path: str | Path) -> "RunDirectory":
        """The study that is in ``path`` already."""
        there = Contents.read(user_path(path) / CONFIG)
        directory = cls(path, there.cells, there.seeds, there.episodes, prepare=False)
        directory.contents = there
        return directory

    @property
    def cells(self) -> list[Cell]:
        """All cells, also those that were not asked for now."""
        return list(self.contents.cells)

    @property
    def seeds(self) -> list[int]:
        """Of each cell's lanes."""
        return list(self.contents.seeds)

    @property
    def episodes(self) -> int:
        """Of the final evaluation of a lane."""
        return self.contents.episodes

    def jobs(self, strategy: str) -> list[Job]:
        """A job for each lane."""
        return self.contents.jobs(strategy)

    def plan(self) -> str:
        """Find what the study will consist of; nothing is written.

        Returns:
            What is new in it, or that more is there than was asked for; for people, mostly empty.
        """
        config = self.path / CONFIG
        if not config.exists():
            return ""
        there = Contents.read(config)
        try:
            self.contents = grown(there, self._asked)
        except UserError as error:
            raise UserError(
                f"--out {self.path} holds another study ({error}); "
                "choose another directory, or remove that one"
            ) from error
        self._check_longer(there)
        self._check_format(config)
        if self.contents != there:
            return f"added to {self.path}: {what_was_added(there, self.contents)}"
        if grown(self._asked, there) != self._asked:
            return (
                f"{self.path} holds more than was asked for: all of its {len(there.cells)} cells "
                f"× {len(there.seeds)} seeds go on"
            )
        return ""

    def prepare(self) -> str:
        """Make the directory, or let the study that is there grow; what `plan` says.

        It is safe at any moment: the configuration is replaced as a whole, and grows only while no
        process writes to the directory.
        """
        config = self.path / CONFIG
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if config.exists():
                return self._grow(config)
            if not all(map(_is_own, self.path.iterdir())):
                raise UserError(
                    f"--out {self.path} is not empty and holds no study; choose another directory"
                )
            study = self.contents.to_dict()
            _write_config(config, {"format": FORMAT, "study": study, "made_with": _made_with()})
        except OSError as error:
            raise UserError(f"--out {self.path} cannot be written: {error.strerror}") from error
        return ""

    def _grow(self, config: Path) -> str:
        for last in (*[False] * _PATIENCE, True):
            news = self.plan()
            if not Contents.read(config).lacks(self._asked):
                return news
            try:
                with writer(self.path, None):
                    news, content = self.plan(), read_config(config)
                    change = {"added": what_was_added(Contents.read(config), self.contents)}
                    if change["added"]:
                        made = {**change, "made_with": _made_with()}
                        content["grown"] = [*content.get("grown", []), made]
                        content["study"] = self.contents.to_dict()
                        _write_config(config, content)
                    return news
            except UserError:
                # Perhaps another shard of the same command is letting it grow just now.
                if last:
                    raise
                time.sleep(_PATIENCE_SECONDS)
        raise AssertionError("the last try returns or raises")

    def refresh(self) -> bool:
        """See what another process has added; whether there is something."""
        before = self.contents
        self.plan()
        return self.contents != before

    def _check_longer(self, there: Contents) -> None:
        """More steps must be able to go on where lanes are."""
        for before, after in longer_cells(there, self.contents):
            steps = after.config.total_steps
            ended = 0
            for seed in there.seeds:
                kept = checkpoint_steps(self.lanes.checkpoint_directory(before, seed))
                done = self.lanes.is_done(before, seed)
                if done and not kept and not self.lanes.is_lost(before, seed):
                    ended += 1
                elif kept:
                    reason = why_not_longer(before.to_dict(), after.to_dict(), max(kept))
                    if reason is not None:
                        raise UserError(
                            f"--out {self.path}: {cell_words(after)} cannot go on to {steps:,} "
                            f"steps: {reason}; choose another directory"
                        )
            if ended:
                raise UserError(
                    f"--out {self.path}: {cell_words(after)} cannot go on to {steps:,} steps: "
                    f"{ended} of its lanes ended at {before.config.total_steps:,} and kept no "
                    "checkpoint (--keep-checkpoints keeps them); choose another directory, or "
                    f"remove {self.path / 'lanes' / cell_name(after)} to train them from the start"
                )

    def has_ended(self) -> bool:
        """Whether no lane is left to train: each is done, or was lost, or failed."""
        return all(
            self.lanes.is_done(cell, seed) or self.lanes.error_path(cell, seed).exists()
            for cell in self.cells
            for seed in self.seeds
        )

    def _check_format(self, config: Path) -> None:
        """Do not train further lanes beside those whose agents read actions in other units."""
        if read_config(config).get("format", 1) == FORMAT or self.has_ended():
            return
        for cell in self.cells:
            env = cell.make_env()
            interface = describe(env, env.default_params)
            if np.any(interface.action_low != -1.0) or np.any(interface.action_high != 1.0):
                raise UserError(
                    f"--out {self.path} was begun by rtd3jax 0.1, whose agents read the actions of "
                    f"{cell.env} in the environment's units; agents now read half ranges, and the "
                    "two do not belong in one table: choose another directory"
                )


def _is_own(entry: Path) -> bool:
    """Whether this may stand in a directory before its study does.

    A lock, or what a process left that was killed while it wrote the configuration.
    """
    half_written = entry.name.startswith(".config.json.") and entry.name.endswith(".tmp")
    return entry.name.startswith(".lock") or half_written


def _write_config(path: Path, content: Any) -> None:
    write_bytes_atomically(path, (json.dumps(content, indent=1) + "\n").encode())


def _made_with() -> dict[str, Any]:
    device = jax.local_devices()[0]
    return {
        "python": platform.python_version(),
        "versions": versions_of(PACKAGES),
        "backend": jax.default_backend(),
        "device": device.device_kind,
        "devices": len(jax.local_devices()),
        "machine": platform.machine(),
    }
