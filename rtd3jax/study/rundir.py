"""A run directory: the study in it, and additions to the study.

The directory holds the configuration (this module), a file for each lane (`lane_files`), the log
(`log`), and results that are derived from the lanes (`derive`).
"""

import json
import platform
import time
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rtd3jax.envs.interface import describe
from rtd3jax.errors import UserError
from rtd3jax.study.cells import Cell
from rtd3jax.study.contents import (
    Contents,
    additions_text,
    extended,
    longer_cells,
    read_config,
)
from rtd3jax.study.lane_files import LaneFiles, cell_name, check_names
from rtd3jax.study.lock import writer
from rtd3jax.study.plants import Plants, check_plants, plant_name, plants_of
from rtd3jax.system.files import (
    user_path,
    write_bytes_atomically,
)
from rtd3jax.system.numbers import check_count
from rtd3jax.system.versions import versions_of
from rtd3jax.training.checkpoint_files import checkpoint_steps
from rtd3jax.training.jobs import Job
from rtd3jax.training.lane_identity import why_not_longer

CONFIG = "config.json"
CONFIG_FORMAT = 2
"""Format of the configuration. Agents of format 1 read actions in the environment's units."""
_PATIENCE, _PATIENCE_SECONDS = 10, 0.1
"""How often, and for how many seconds, a shard waits for another that extends the study."""
PACKAGES = ("rtd3jax", "jax", "jaxlib", "flax", "optax", "gymnax", "numpy")


class RunDirectory:
    """The directory of one sweep, in which nothing is written before `prepare`."""

    def __init__(
        self,
        path: str | Path,
        cells: Sequence[Cell],
        seeds: Sequence[int],
        episodes: int,
    ):
        self.path = user_path(path)
        self.lanes = LaneFiles(self.path)
        self._made: Plants = {}
        self._asked = self.contents = Contents(tuple(cells), tuple(seeds), episodes)

    @classmethod
    def create(
        cls, path: str | Path, cells: Sequence[Cell], seeds: Sequence[int], episodes: int
    ) -> "RunDirectory":
        """Write a new study, or add seeds, cells and steps to the existing study in ``path``.

        Raises:
            UserError: when an existing lane would change, or the directory cannot be written.
        """
        directory = cls(path, cells, seeds, episodes)
        directory.prepare()
        return directory

    @classmethod
    def open(cls, path: str | Path) -> "RunDirectory":
        """Open the existing study in ``path``.

        Raises:
            UserError: when there is no study, or an agent or memory of it is not registered.
        """
        there = Contents.read(user_path(path) / CONFIG)
        directory = cls(path, there.cells, there.seeds, there.episodes)
        directory.contents = there
        return directory

    @property
    def cells(self) -> list[Cell]:
        """All cells of the study, also those that this sweep does not name."""
        return list(self.contents.cells)

    @property
    def seeds(self) -> list[int]:
        """The seeds of each cell."""
        return list(self.contents.seeds)

    @property
    def episodes(self) -> int:
        """Number of episodes in the final evaluation of a lane."""
        return self.contents.episodes

    def own_seed(self, seed: int) -> int:
        """``seed`` as an integer; UserError if it is not a seed of the study."""
        check_count("seed", seed, 0)
        if seed not in self.seeds:
            raise UserError(f"{self.path} has no seed {seed}; its seeds are {self.seeds}")
        return int(seed)

    def jobs(self, strategy: str) -> list[Job]:
        """A job for each lane."""
        return self.contents.jobs(strategy)

    def plan(self) -> str:
        """Determine the contents of the study, without writing anything.

        Returns:
            A message about plants whose code has changed, about additions, or about cells and
            seeds that this sweep does not name; it is usually empty.

        Raises:
            UserError: when an existing lane or plant would change.
        """
        config = self.path / CONFIG
        if not config.exists():
            check_names(self.cells)
            return ""
        there = Contents.read(config)
        try:
            self.contents = extended(there, self._asked)
        except UserError as error:
            raise UserError(
                f"--out {self.path} holds another study ({error}); "
                "choose another directory, or remove that one"
            ) from error
        news = self.check_plants(self._plants(self.contents.cells))
        self._check_longer(there)
        self._check_format(config)
        if self.contents != there:
            check_names(self.cells, len(there.cells))
            news.append(f"added to {self.path}: {additions_text(there, self.contents)}")
        elif extended(self._asked, there) != self._asked:
            news.append(
                f"{self.path} holds more cells or seeds than this command names: all of its "
                f"{len(there.cells)} cells × {len(there.seeds)} seeds are continued"
            )
        return "\n".join(news)

    def longer(self) -> list[Cell]:
        """The cells of the existing study that `prepare` will give more steps."""
        if not (self.path / CONFIG).exists():
            return []
        there = Contents.read(self.path / CONFIG)
        return [after for _, after in longer_cells(there, self.contents)]

    def known_plants(self) -> Plants:
        """The plants with which the study was begun or extended; none in an earlier version."""
        return read_config(self.path / CONFIG).get("plants", {})

    def identity(self) -> str:
        """A text that no other study has, also if it was here before, or is a copy.

        It is the path alone if an earlier version began the study.
        """
        return read_config(self.path / CONFIG).get("id", "") + str(self.path.resolve())

    def check_plants(self, now: Plants) -> list[str]:
        """Lines about changed plants of this study; `rtd3jax.study.plants.check_plants`."""
        return check_plants(self.path, self.known_plants(), now)

    def prepare(self) -> str:
        """Create the directory, or extend its study; return the message of `plan`.

        The configuration is written atomically, and only while no other process writes to the
        directory.

        Raises:
            UserError: as `plan` does, or when the directory holds other files, cannot be written,
                or another process writes to it.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if not holds_study(self.path) and not all(map(_is_own, self.path.iterdir())):
                raise UserError(
                    f"--out {self.path} is not empty and holds no study; choose another directory"
                )
            self._plants(self._asked.cells)  # takes time: below, other shards would wait for it
            for last in (*[False] * _PATIENCE, True):
                news = self.plan()
                if holds_study(self.path) and not self._lacks_something():
                    return news
                try:
                    with writer(self.path, None):
                        return self._write()
                except UserError:
                    # Another shard of the same command may be doing the same at this moment.
                    if last:
                        raise
                    time.sleep(_PATIENCE_SECONDS)
        except OSError as error:
            raise UserError(f"--out {self.path} cannot be written: {error.strerror}") from error
        raise AssertionError("the last attempt returns or raises")

    def _lacks_something(self) -> bool:
        return Contents.read(self.path / CONFIG).lacks(self._asked)

    def _write(self) -> str:
        """Write the configuration, or the additions to it; return the message of `plan`."""
        config, news = self.path / CONFIG, self.plan()
        if not config.exists():
            study = self.contents.to_dict()
            made_with, plants = _made_with(), self._plants(self.contents.cells)
            new = {
                "format": CONFIG_FORMAT,
                "id": uuid.uuid4().hex,
                "study": study,
                "plants": plants,
                "made_with": made_with,
            }
            _write_config(config, new)
            return news
        content = read_config(config)
        if added := additions_text(Contents.read(config), self.contents):
            content["grown"] = [
                *content.get("grown", []),
                {"added": added, "made_with": _made_with()},
            ]
            content["study"] = self.contents.to_dict()
            plants = self._plants(self._asked.cells)
            content["plants"] = {**plants, **content.get("plants", {})}
            _write_config(config, content)
        return news

    def _plants(self, cells: Sequence[Cell]) -> Plants:
        """The plants of these cells; their environments are made once.

        A cell that this sweep does not name may be of an environment that it does not know. That is
        an error when the cell is trained, but not when the study is only read.
        """
        for cell in cells:
            if plant_name(cell) in self._made:
                continue
            try:
                self._made |= plants_of([cell])
            except UserError:
                if cell in self._asked.cells:
                    raise
        names = map(plant_name, cells)
        return {name: self._made[name] for name in names if name in self._made}

    def refresh(self) -> bool:
        """Read additions of another process; return whether there are any."""
        before = self.contents
        self.plan()
        return self.contents != before

    def _check_longer(self, there: Contents) -> None:
        """Raise UserError if existing lanes cannot continue to more steps."""
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
                            f"--out {self.path}: {after.words} cannot continue to {steps:,} "
                            f"steps: {reason}; choose another directory"
                        )
            if ended:
                raise UserError(
                    f"--out {self.path}: {after.words} cannot continue to {steps:,} steps: "
                    f"{ended} of its lanes ended at {before.config.total_steps:,} without a "
                    "checkpoint (--keep-checkpoints keeps it); choose another directory, or "
                    f"remove {self.path / 'lanes' / cell_name(after)} to train them from the start"
                )

    def has_ended(self) -> bool:
        """Whether every lane has ended: it was trained to its end, was lost, or failed."""
        return all(
            self.lanes.is_done(cell, seed) or self.lanes.error_path(cell, seed).exists()
            for cell in self.cells
            for seed in self.seeds
        )

    def _check_format(self, config: Path) -> None:
        """Raise UserError for a run of version 0.1, whose agents read actions in other units."""
        if read_config(config).get("format", 1) != 1 or self.has_ended():
            return
        for cell in self.cells:
            env = cell.make_env()
            interface = describe(env, env.default_params)
            if np.any(interface.action_low != -1.0) or np.any(interface.action_high != 1.0):
                raise UserError(
                    f"--out {self.path} was begun by rtd3jax 0.1, whose agents read the actions of "
                    f"{cell.env} in the environment's units; agents now read half ranges, so the "
                    "results are not comparable: choose another directory"
                )


def holds_study(path: Path) -> bool:
    """Whether a study was begun in the directory."""
    return (path / CONFIG).exists()


def _is_own(entry: Path) -> bool:
    """Whether ``entry`` may exist in a directory without a study.

    It may be a lock, or a temporary file of a process that was killed while it wrote the
    configuration.
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
