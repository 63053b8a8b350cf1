"""The contents of a study, as in ``config.json``, and their extension.

A study consists of all cells with all seeds. Seeds, cells, and more steps of a cell can be added; a
change that would alter an existing lane is refused.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rtd3jax.config import Config
from rtd3jax.errors import UserError
from rtd3jax.registries import AGENTS, MEMORIES
from rtd3jax.study.cells import Cell, cell_jobs
from rtd3jax.system.versions import versions_of
from rtd3jax.training.arguments import check_seeds
from rtd3jax.training.jobs import Job
from rtd3jax.training.lane_identity import LONGER

_NAMED = 3
"""Number of items that a message lists by name."""


@dataclasses.dataclass(frozen=True)
class Contents:
    """Cells, each with all seeds.

    Attributes:
        cells: the cells; added cells come last.
        seeds: the seeds; added seeds come last.
        episodes: number of episodes in the final evaluation.
        stages: number of cells before each addition of cells.
    """

    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]
    episodes: int
    stages: tuple[int, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The contents as in config.json."""
        found = {
            "cells": [cell.to_dict() for cell in self.cells],
            "seeds": list(self.seeds),
            "final_episodes": self.episodes,
        }
        return {**found, "stages": list(self.stages)} if self.stages else found

    @classmethod
    def read(cls, config: Path) -> "Contents":
        """The contents in a configuration file.

        Raises:
            UserError: when there is no such file, or it is not a study's.
        """
        content = read_config(config)
        study = content["study"]
        try:
            for cell in study["cells"]:
                _check_fields(config, dict(cell), content)
                _check_registered(config, dict(cell))
            cells = tuple(Cell.from_dict(dict(cell)) for cell in study["cells"])
            seeds, episodes = check_seeds(study["seeds"]), int(study["final_episodes"])
            stages = tuple(int(count) for count in study.get("stages", ()))
        except _Unknown:
            raise
        except UserError as error:  # an impossible value
            raise UserError(f"{config} is not a study's configuration: {error}") from error
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{config} is not a study's configuration") from error
        return cls(cells, seeds, episodes, stages)

    def check_cell(self, path: Path, cell: Cell) -> None:
        """Raise UserError unless the study in ``path`` has this cell, with the same settings."""
        own = next((one for one in self.cells if one.key == cell.key), None)
        if own is None:
            raise UserError(f"{path} has no cell {cell.words}, only {_words_of(self.cells)}")
        there, here = own.to_dict(), cell.to_dict()
        longer = there["total_steps"] != here["total_steps"]  # the lane's file states its steps
        for name in there:
            if there[name] != here[name] and not (longer and name in LONGER):
                raise UserError(
                    f"{path} has {cell.words} with another {name} ({there[name]} there, "
                    f"{here[name]} here): pass the cell as the study has it"
                )

    def jobs(self, strategy: str) -> list[Job]:
        """A job for each lane; see `cell_jobs`."""
        return cell_jobs(self.cells, self.seeds, strategy, self.stages)

    def lacks(self, asked: "Contents") -> bool:
        """Whether ``asked`` contains something that this study does not contain.

        Raises:
            UserError: when ``asked`` would change an existing lane.
        """
        return extended(self, asked) != self


class _Unknown(UserError):
    """The study has fields, agents or memories that are not known in this process."""


def _check_fields(config: Path, cell: dict[str, Any], content: dict[str, Any]) -> None:
    """Raise UserError if the cell has a field that this version of the package does not have."""
    known = {"env", "disturbance", *(field.name for field in dataclasses.fields(Config))}
    for name in cell:
        if name not in known:
            raise _Unknown(
                f"{config}: this version of rtd3jax ({versions_of(['rtd3jax'])['rtd3jax']}) does "
                f"not know the field {name!r}{_writer_of(content)}"
            )


def _writer_of(content: dict[str, Any]) -> str:
    """The version that wrote a configuration last, in words; empty if it is not stated."""
    try:
        last = [content, *content.get("grown", [])][-1]
        version = str(last["made_with"]["versions"]["rtd3jax"])
    except (KeyError, TypeError, AttributeError):
        return ""
    return f"; version {version} wrote it: install that version"


def _check_registered(config: Path, cell: dict[str, Any]) -> None:
    for field, known in (("algorithm", AGENTS), ("memory", MEMORIES)):
        name = cell.get(field)
        if isinstance(name, str) and name not in known:
            raise _Unknown(
                f"{config}: {field} {name!r} is not known here, only {', '.join(known)}; register "
                "it before you open the study, or name its module with --import"
            )


def read_config(config: Path) -> dict[str, Any]:
    """The content of a configuration file.

    Raises:
        UserError: when there is no such file, or it is not a study's.
    """
    try:
        content = json.loads(config.read_text("utf-8"))
        content["study"]["cells"]
        return content
    except OSError as error:
        raise UserError(f"there is no study in {config.parent} ({error.strerror})") from error
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{config} is not a study's configuration") from error


def extended(there: Contents, asked: Contents) -> Contents:
    """The contents ``there`` with the additions of ``asked``.

    Raises:
        UserError: naming the field, when an existing lane would change.
    """
    if there.episodes != asked.episodes:
        raise UserError(f"final_episodes: {there.episodes} there, {asked.episodes} here")
    wanted = {_key(cell): cell for cell in asked.cells}
    cells = [_with_more_steps(cell, wanted.pop(_key(cell), cell)) for cell in there.cells]
    stages = there.stages
    if wanted:
        cells, stages = [*cells, *wanted.values()], (*stages, len(cells))
    seeds = tuple(dict.fromkeys((*there.seeds, *asked.seeds)))
    return Contents(tuple(cells), seeds, there.episodes, stages)


def longer_cells(there: Contents, now: Contents) -> list[tuple[Cell, Cell]]:
    """Pairs (before, after) of cells that have more steps now."""
    pairs = zip(there.cells, now.cells, strict=False)
    return [(before, after) for before, after in pairs if before != after]


def additions_text(there: Contents, now: Contents) -> str:
    """The additions in words, for a message of one line; empty without additions."""
    added = now.cells[len(there.cells) :]
    words = []
    if seeds := now.seeds[len(there.seeds) :]:
        words.append(f"seed{'s' * (len(seeds) > 1)} {_listed(list(map(str, seeds)))}")
    if added:
        one = f"{len(added)} cell{'s' * (len(added) > 1)}"
        words.append(f"{one} ({_listed([cell.words for cell in added])}{_unusual(there, added)})")
    for before, after in longer_cells(there, now):
        words.append(
            f"{after.config.total_steps:,} steps for {before.config.total_steps:,} of {after.words}"
        )
    return ", ".join(words[:_NAMED] + (["more steps of other cells"] if words[_NAMED:] else []))


def _key(cell: Cell) -> tuple[Any, ...]:
    return tuple(cell.key.values())


def _with_more_steps(there: Cell, asked: Cell) -> Cell:
    """``asked`` if it only has more steps than ``there``, and ``there`` if both are equal.

    Raises:
        UserError: when the cells differ otherwise.
    """
    before, after = there.to_dict(), asked.to_dict()
    longer = after["total_steps"] > before["total_steps"]
    for name in before:
        if before[name] != after[name] and not (longer and name in LONGER):
            raise UserError(f"{name}: {before[name]} there, {after[name]} here")
    return asked if longer else there


def _unusual(there: Contents, added: Sequence[Cell]) -> str:
    """Fields in which added cells differ from all earlier cells: a flag may have been forgotten."""
    old = [cell.to_dict() for cell in there.cells]
    words: dict[str, None] = {}
    for cell in added:
        for name, value in _own(cell).items():
            if all(other[name] != value for other in old):
                before = _listed(list(dict.fromkeys(str(other[name]) for other in old)))
                words[f"{name} {value}, before {before}"] = None
    return "".join(f"; {word}" for word in words)


def _own(cell: Cell) -> Mapping[str, Any]:
    """The configuration without the fields that identify the cell."""
    names = {"replay_capacity", *cell.key}  # its default is total_steps
    return {n: value for n, value in cell.config.to_dict().items() if n not in names}


def _words_of(cells: Sequence[Cell]) -> str:
    return _listed([cell.words for cell in cells])


def _listed(words: Sequence[str]) -> str:
    few = [*words[:_NAMED], f"{len(words) - _NAMED} more"] if len(words) > _NAMED + 1 else words
    return ", ".join(few)
