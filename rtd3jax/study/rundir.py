"""A run directory: its configuration, a file per finished lane, and what is derived from them.

``lanes/<cell>/seed-<n>.safetensors`` holds a lane's trained actor, its learning curve and its
final episodes. Tables, pictures and the summary are made from those files alone, so that they are
the same whatever the order in which lanes ended, and can be made again at any time.
"""

import dataclasses
import json
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rtd3jax.envs.interface import describe
from rtd3jax.errors import UserError
from rtd3jax.policies.serialization import read_interface, restore_policy
from rtd3jax.policies.trained import FORMAT, Policy
from rtd3jax.study.ceilings import ceilings_of
from rtd3jax.study.figures import final_returns, learning_curves
from rtd3jax.study.lock import deriver, is_held
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
    flatten,
    read_arrays,
    user_path,
    write_arrays,
    write_bytes_atomically,
)
from rtd3jax.system.versions import versions_of
from rtd3jax.training.checkpoint import checkpoint_steps
from rtd3jax.training.run import check_seeds

_CURVE_ARRAYS = ("steps", "returns", "true_returns")
_FINAL_ARRAYS = ("final_returns", "final_true_returns")
LOG = "log.jsonl"
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

    Raises:
        UserError: when it holds another study, or cannot be written.
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
        self.cells = list(cells)
        self.seeds = list(seeds)
        self.episodes = episodes
        self._study = {
            "cells": [cell.to_dict() for cell in cells],
            "seeds": list(seeds),
            "final_episodes": episodes,
        }
        if prepare:
            self._prepare()

    @classmethod
    def open(cls, path: str | Path) -> "RunDirectory":
        """The study that is in ``path`` already."""
        study = _read_study(user_path(path) / "config.json")
        try:
            cells = [Cell.from_dict(dict(cell)) for cell in study["cells"]]
            seeds, episodes = check_seeds(study["seeds"]), int(study["final_episodes"])
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{path}/config.json is not a study's configuration") from error
        return cls(path, cells, seeds, episodes, prepare=False)

    def _prepare(self) -> None:
        """Make the directory, or see that it holds this study."""
        config = self.path / "config.json"
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if config.exists():
                self._check_same(config)
                self._check_format(config)
                return
            if not all(map(_is_own, self.path.iterdir())):
                raise UserError(
                    f"--out {self.path} is not empty and holds no study; choose another directory"
                )
            content = {"format": FORMAT, "study": self._study, "made_with": _made_with()}
            write_bytes_atomically(config, (json.dumps(content, indent=1) + "\n").encode())
        except OSError as error:
            raise UserError(f"--out {self.path} cannot be written: {error.strerror}") from error

    def _check_same(self, config: Path) -> None:
        study = _with_defaults(_read_study(config))
        if study != json.loads(json.dumps(self._study)):
            raise UserError(
                f"--out {self.path} holds another study ({_difference(study, self._study)}); "
                "choose another directory, or remove that one"
            )

    def _check_format(self, config: Path) -> None:
        """Do not train further lanes beside those whose agents read actions in other units."""
        if json.loads(config.read_text("utf-8")).get("format", 1) == FORMAT or self.has_ended():
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
        """Whether the lane was trained to its end."""
        return self.lane_path(cell, seed).exists()

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
        actor: Any,
        curves: dict[str, np.ndarray],
        metrics: dict[str, np.ndarray],
        failure: dict[str, Any] | None,
        interface: dict[str, Any] | None = None,
    ) -> None:
        """Keep a lane that ended.

        Args:
            cell: its cell.
            seed: its seed.
            actor: parameters of the actor, a nested dict.
            curves: ``steps``, ``returns``, ``true_returns`` [K] and ``final_returns``,
                ``final_true_returns`` [episodes].
            metrics: of learning, [K] by name.
            failure: step and reason, if the lane was lost.
            interface: what `Policy.interface` says of its policy, which then can be loaded where
                the cell's environment is not registered.
        """
        arrays = {f"actor.{name}": value for name, value in flatten(actor).items()}
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
            {n.removeprefix("actor."): a for n, a in arrays.items() if n.startswith("actor.")},
            interface,
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
            "final episodes per seed": self._study["final_episodes"],
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


def _read_study(config: Path) -> Any:
    try:
        return json.loads(config.read_text("utf-8"))["study"]
    except OSError as error:
        raise UserError(f"there is no study in {config.parent} ({error.strerror})") from error
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{config} is not a study's configuration") from error


def _with_defaults(study: Any) -> Any:
    """``study``, a field of the configuration that it was written without at its default."""
    try:
        cells = [Cell.from_dict(dict(cell)).to_dict() for cell in study["cells"]]
    except (UserError, KeyError, TypeError, ValueError):
        return study  # it is another study then, and the difference is named
    return {**study, "cells": cells}


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


def _difference(old: Any, new: Any) -> str:
    """The first thing in which two studies differ, in words."""
    for name in ("seeds", "final_episodes"):
        if old.get(name) != new[name]:
            return f"{name}: {old.get(name)} there, {new[name]} here"
    before, after = old.get("cells", []), json.loads(json.dumps(new["cells"]))
    if len(before) != len(after):
        return f"{len(before)} cells there, {len(after)} here"
    for one, other in zip(before, after, strict=True):
        for name in other:
            if one.get(name) != other[name]:
                return f"{name}: {one.get(name)} there, {other[name]} here"
    return "another format"
