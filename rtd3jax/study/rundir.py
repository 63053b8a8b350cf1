"""A run directory: its configuration, a file per finished lane, and what is derived from them.

``lanes/<cell>/seed-<n>.safetensors`` holds a lane's trained actor, its learning curve and its
final episodes. Tables, pictures and the summary are made from those files alone, so that they are
the same whatever the order in which lanes ended, and can be made again at any time.
"""

import dataclasses
import json
import platform
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rtd3jax.envs.interface import describe
from rtd3jax.errors import UserError
from rtd3jax.policies.serialization import below, read_interface, restore_policy
from rtd3jax.policies.trained import FORMAT, Policy
from rtd3jax.study.ceilings import ceilings_of
from rtd3jax.study.contents import (
    Contents,
    cell_words,
    grown,
    longer_cells,
    read_config,
    what_was_added,
)
from rtd3jax.study.figures import final_returns, learning_curves
from rtd3jax.study.lock import deriver, is_held, writer
from rtd3jax.study.plan import Cell
from rtd3jax.study.results import (
    CELL,
    CURVES,
    EPISODES,
    METRICS,
    REFERENCE_SEED,
    read_table,
    write_table,
)
from rtd3jax.study.summary import summary_markdown
from rtd3jax.system.files import (
    read_about,
    read_arrays,
    user_path,
    write_arrays,
    write_bytes_atomically,
)
from rtd3jax.system.versions import versions_of
from rtd3jax.training.checkpoint import checkpoint_steps, why_not_longer
from rtd3jax.training.lanes import Job

_CURVE_ARRAYS = ("steps", "returns", "true_returns")
_FINAL_ARRAYS = ("final_returns", "final_true_returns")
CONFIG = "config.json"
LOG = "log.jsonl"
_PATIENCE, _PATIENCE_SECONDS = 10, 0.1
"""How often, and how long, a shard waits for another one that lets the study grow."""
PACKAGES = ("rtd3jax", "jax", "jaxlib", "flax", "optax", "gymnax", "numpy")


@dataclasses.dataclass(frozen=True)
class Reference:
    """Returns of a policy that needs no training: [episodes] each."""

    env: str
    disturbance: str
    name: str
    returns: np.ndarray
    true_returns: np.ndarray


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
                kept = checkpoint_steps(self.checkpoint_directory(before, seed))
                if self.is_done(before, seed) and not kept and not self._is_lost(before, seed):
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

    def lane_path(self, cell: Cell, seed: int) -> Path:
        """Where a lane's file is."""
        return self._within("lanes", cell_name(cell), f"seed-{seed}.safetensors")

    def checkpoint_directory(self, cell: Cell, seed: int) -> Path:
        """Where a lane that is under way keeps its checkpoints."""
        return self._within("checkpoints", cell_name(cell), f"seed-{seed}")

    def playback_path(self, cell: Cell, seed: int) -> Path:
        """Where the page keeps the episodes that a lane's policy played for it."""
        return self._within("playback", cell_name(cell), f"seed-{seed}.json")

    def _within(self, *parts: str) -> Path:
        """A path inside the directory, also where links lead elsewhere."""
        path = self.path.joinpath(*parts)
        if not path.resolve().is_relative_to(self.path.resolve()):
            raise UserError(f"{path} leads outside {self.path}; remove the link")
        return path

    def error_path(self, cell: Cell, seed: int) -> Path:
        """Where the reason stands for which a lane could not be trained."""
        return self.lane_path(cell, seed).with_suffix(".error.txt")

    def is_done(self, cell: Cell, seed: int) -> bool:
        """Whether the lane was trained to its end, be it lost; with more steps later, to that."""
        path = self.lane_path(cell, seed)
        if not path.exists():
            return False
        try:
            about = read_about(path)
            return about["cell"]["total_steps"] == cell.config.total_steps or self._is_lost(
                cell, seed
            )
        except (UserError, KeyError, TypeError):
            return True  # whoever reads it says what is wrong with it

    def _is_lost(self, cell: Cell, seed: int) -> bool:
        """Whether the lane, which has a file, was lost in training."""
        return read_about(self.lane_path(cell, seed))["failure"] is not None

    def has_ended(self) -> bool:
        """Whether no lane is left to train: each is done, or was lost, or failed."""
        return all(
            self.is_done(cell, seed) or self.error_path(cell, seed).exists()
            for cell in self.cells
            for seed in self.seeds
        )

    def write_lane(
        self,
        cell: Cell,
        seed: int,
        parameters: dict[str, np.ndarray],
        curves: dict[str, np.ndarray],
        metrics: dict[str, np.ndarray],
        failure: dict[str, Any] | None,
        interface: dict[str, Any] | None = None,
    ) -> None:
        """Keep a lane that ended.

        Args:
            cell: its cell.
            seed: its seed.
            parameters: of its policy, as `Policy.parameters` names them.
            curves: ``steps``, ``returns``, ``true_returns`` [K] and ``final_returns``,
                ``final_true_returns`` [episodes].
            metrics: of learning, [K] by name.
            failure: step and reason, if the lane was lost.
            interface: what `Policy.interface` says of its policy, which then can be loaded where
                the cell's environment is not registered.
        """
        arrays = dict(parameters)
        arrays |= {f"results.{name}": np.asarray(value) for name, value in curves.items()}
        arrays |= {f"metrics.{name}": np.asarray(value) for name, value in metrics.items()}
        about = {"format": FORMAT, "cell": cell.to_dict(), "seed": seed, "failure": failure}
        if interface is not None:
            about["interface"] = interface
        write_arrays(self.lane_path(cell, seed), arrays, about)

    def policy(self, cell: Cell, seed: int) -> Policy:
        """The trained policy of a lane.

        Raises:
            UserError: when the lane was not trained to its end or was lost, or when its file is
                damaged or does not fit the environment.
        """
        lane = f"{cell_name(cell)} seed {seed}"
        if not self.is_done(cell, seed):
            raise UserError(
                f"{lane} is not trained yet in {self.path}; --status tells how far it is"
            )
        path = self.lane_path(cell, seed)
        arrays, about = read_arrays(path)
        if about["failure"] is not None:
            raise UserError(f"{lane} was lost in training: {about['failure']['reason']}")
        if isinstance(about.get("interface"), dict):
            interface = read_interface(path, about["interface"])
        else:  # of a version that did not write it
            env = cell.make_env()
            interface = describe(env, env.default_params)
        return restore_policy(
            path,
            below(arrays, "actor"),
            interface,
            normaliser=below(arrays, "normaliser"),
            algorithm=cell.config.algorithm,
            history_length=cell.config.tokens,
            width=cell.config.hidden_size,
            memory=cell.config.memory,
            acting="carry" if cell.config.runs_on else "window",
            format=about.get("format", 1),
        )

    def write_error(self, cell: Cell, seed: int, reason: str) -> None:
        """Keep the reason for which a lane could not be trained."""
        write_bytes_atomically(self.error_path(cell, seed), (reason + "\n").encode())

    def repair_log(self) -> set[tuple[Any, ...]]:
        """End a line that was cut short; the lanes and steps that the log has."""
        log = self.path / LOG
        if log.exists() and not log.read_bytes().endswith(b"\n"):
            with log.open("a", encoding="utf-8") as file:
                file.write("\n")
        return {(*lane_of(row), row["step"]) for row in read_log(log)}

    def ledger(self) -> list[dict[str, Any]]:
        """Each lane's state: done, lost, failed, running, interrupted (at a step), or planned.

        Nothing is kept for it: it is read from the lanes' files, the log and the lock, so that it
        cannot disagree with them.
        """
        begun = "running" if is_held(self.path) else "interrupted"
        logged = steps_reached(read_log(self.path / LOG))
        return [
            {**cell.key, "seed": seed, **self._lane_status(cell, seed, begun, logged)}
            for cell in self.cells
            for seed in self.seeds
        ]

    def _lane_status(
        self, cell: Cell, seed: int, begun: str, logged: dict[Any, int]
    ) -> dict[str, Any]:
        if self.is_done(cell, seed):
            failure = read_arrays(self.lane_path(cell, seed))[1]["failure"]
            if failure is not None:
                return {"status": "lost", "step": failure["step"], "reason": failure["reason"]}
            return {"status": "done", "step": cell.config.total_steps, "reason": ""}
        if self.error_path(cell, seed).exists():
            reason = self.error_path(cell, seed).read_text("utf-8").strip()
            return {"status": "failed", "step": 0, "reason": reason}
        steps = checkpoint_steps(self.checkpoint_directory(cell, seed))
        kept = max(steps, default=0)
        reached = logged.get(lane_of({**cell.key, "seed": seed}), 0)
        # A lane that is logged to its end but has no file was removed, to be trained again.
        reached = max(kept, reached if reached < cell.config.total_steps else 0)
        reason = f"next start at step {kept:,}" if reached and begun != "running" else ""
        return {"status": begun if reached else "planned", "step": reached, "reason": reason}

    def derive(self, references: Iterable[Reference], *, pictures: bool = True) -> None:
        """Write tables, pictures and the summary of the lanes there are."""
        # Shards that end together: the last to come here sees the lanes of all.
        with deriver(self.path):
            self._derive(references, pictures)

    def _derive(self, references: Iterable[Reference], pictures: bool) -> None:
        curves: list[dict[str, Any]] = []
        episodes: list[dict[str, Any]] = []
        failures: list[dict[str, Any]] = []
        metrics: list[dict[str, Any]] = []
        for cell in self.cells:
            for seed in self.seeds:
                if self.is_done(cell, seed):
                    self._read_lane(cell, seed, curves, episodes, metrics, failures)
        for reference in references:
            episodes += _reference_rows(reference)
        write_table(self.path / "curves.parquet", curves, CURVES)
        write_table(self.path / "episodes.parquet", episodes, EPISODES)
        write_table(self.path / "metrics.parquet", metrics, METRICS)
        curve_table = read_table(self.path / "curves.parquet", CURVES)
        episode_table = read_table(self.path / "episodes.parquet", EPISODES)
        best = ceilings_of(self.path, self.cells, compute=False)
        text = summary_markdown(self._excerpt(), curve_table, episode_table, failures, best)
        write_bytes_atomically(self.path / "summary.md", text.encode())
        if pictures:
            learning_curves(curve_table, episode_table, self.path, best)
            final_returns(episode_table, self.path, best)

    def _read_lane(
        self,
        cell: Cell,
        seed: int,
        curves: list[dict[str, Any]],
        episodes: list[dict[str, Any]],
        metrics: list[dict[str, Any]],
        failures: list[dict[str, Any]],
    ) -> None:
        path = self.lane_path(cell, seed)
        row = {**cell.key, "seed": seed}
        try:
            arrays, about = read_arrays(path)
            failure = about["failure"]
            points = zip(*(arrays[f"results.{n}"] for n in _CURVE_ARRAYS), strict=True)
            finals = zip(*(arrays[f"results.{n}"] for n in _FINAL_ARRAYS), strict=True)
            curves += [
                {**row, "step": int(step), "return": value, "true_return": true}
                for step, value, true in points
            ]
            episodes += [
                {**row, "episode": episode, "return": value, "true_return": true}
                for episode, (value, true) in enumerate(finals)
            ]
            metrics += [
                {**row, "step": int(step), "metric": name.removeprefix("metrics."), "value": value}
                for name in sorted(arrays)
                if name.startswith("metrics.")
                for step, value in zip(arrays["results.steps"], arrays[name], strict=True)
            ]
        except (UserError, KeyError, ValueError, TypeError) as error:
            raise UserError(
                f"{error}: remove {path}, and the same command trains that lane again"
            ) from error
        if failure is not None:
            failures.append({**row, **failure})

    def _excerpt(self) -> dict[str, object]:
        """What the cells have in common, and whose fields differ, for the summary."""
        dicts = [cell.to_dict() for cell in self.cells]
        fields = {}
        for name in dicts[0]:
            if len({cell[name] for cell in dicts}) == 1:
                fields[name] = dicts[0][name]
            elif name not in self.cells[0].key:  # those stand in the summary's tables
                fields[name] = _whose(name, dicts)
        return {
            "cells": len(self.cells),
            "seeds": len(self.seeds),
            "final episodes per seed": self.episodes,
            **fields,
        }


def _whose(name: str, cells: Sequence[Mapping[str, Any]]) -> str:
    """The values of a field in which cells differ, and whose they are: the world's, the agent's."""
    within: dict[str, set[Any]] = {}
    for cell in cells:
        within.setdefault(cell["env"], set()).add(cell[name])
    owners: dict[Any, dict[str, None]] = {}
    for cell in cells:
        env, algorithm = cell["env"], cell["algorithm"]
        one = f"{env}: {algorithm}" if len(within) > 1 else algorithm
        owners.setdefault(cell[name], {})[env if len(within[env]) == 1 else one] = None
    return "; ".join(f"{value} ({', '.join(own)})" for value, own in owners.items())


def _is_own(entry: Path) -> bool:
    """Whether this may stand in a directory before its study does.

    A lock, or what a process left that was killed while it wrote the configuration.
    """
    half_written = entry.name.startswith(".config.json.") and entry.name.endswith(".tmp")
    return entry.name.startswith(".lock") or half_written


def _write_config(path: Path, content: Any) -> None:
    write_bytes_atomically(path, (json.dumps(content, indent=1) + "\n").encode())


def read_log(path: Path) -> list[dict[str, Any]]:
    """Rows of a log; a line that a killed process left half-written is passed over."""
    return parse_log(path.read_text("utf-8")) if path.exists() else []


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
    """The lane that a row is of: its cell's key and its seed."""
    return tuple(row[name] for name in (*CELL, "seed"))


def steps_reached(rows: Iterable[dict[str, Any]]) -> dict[tuple[Any, ...], int]:
    """The last step of each lane in a log."""
    reached: dict[tuple[Any, ...], int] = {}
    for row in rows:
        lane = lane_of(row)
        reached[lane] = max(row["step"], reached.get(lane, 0))
    return reached


def cell_name(cell: Cell) -> str:
    """A directory name that tells cells apart."""
    text = f"{cell.env}_{cell.disturbance}_{cell.config.algorithm}_l{cell.config.history_length}"
    return re.sub(r"[^A-Za-z0-9._=+-]", "-", text)


def _reference_rows(reference: Reference) -> list[dict[str, Any]]:
    key = {
        "env": reference.env,
        "disturbance": reference.disturbance,
        "algorithm": reference.name,
        "history_length": 0,
        "seed": REFERENCE_SEED,
    }
    pairs = zip(reference.returns, reference.true_returns, strict=True)
    return [
        {**key, "episode": episode, "return": value, "true_return": true}
        for episode, (value, true) in enumerate(pairs)
    ]


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
