"""The plants of a study: the same name must mean the same plant as long as the study grows."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rtd3jax.errors import UserError
from rtd3jax.study.plan import Cell
from rtd3jax.training.checkpoint import difference, same
from rtd3jax.training.plant import plant_of

Plants = dict[str, dict[str, Any]]
"""The identity of each pair of an environment and a disturbance, by `plant_name`."""


def plants_of(cells: Iterable[Cell]) -> Plants:
    """The plants of these cells, as their code makes them now."""
    first = {plant_name(cell): cell for cell in cells}
    return {name: _made(cell) for name, cell in first.items()}


def plant_name(cell: Cell) -> str:
    """The environment and the disturbance of a cell."""
    return f"{cell.env} {cell.disturbance}"


def check_plants(path: Path, before: Plants, now: Plants) -> None:
    """Raise UserError if a plant of the study in ``path`` is another one now.

    A study of an earlier version does not state its plants, which then count as the same.
    """
    for name, plant in now.items():
        if name in before and not same(before[name], plant):
            raise UserError(
                f"--out {path} holds lanes of another plant with the name {name} "
                f"({difference(before[name], plant)}): choose another directory, or register the "
                "changed plant under another name"
            )


def _made(cell: Cell) -> dict[str, Any]:
    env = cell.make_env()
    return plant_of(env, env.default_params)
