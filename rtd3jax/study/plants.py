"""The plants of a study: the same name must mean the same plant as long as the study grows."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax

from rtd3jax.envs.interface import describe
from rtd3jax.errors import UserError
from rtd3jax.study.cells import Cell
from rtd3jax.study.plant_code import code_of, is_other_code
from rtd3jax.training.lane_identity import difference, same
from rtd3jax.training.plant import plant_of

Plants = dict[str, dict[str, Any]]
"""The identity of each pair of an environment and a disturbance, by `plant_name`."""

CODE = "code"
"""The part of an identity that identifies what the code of the environment computes."""

NAMES = "names"
"""The part of an identity that names its numbers, for messages."""


def plants_of(cells: Iterable[Cell]) -> Plants:
    """The plants of these cells, as their code makes them now."""
    by_name = {plant_name(cell): cell for cell in cells}
    return {name: _made(cell) for name, cell in by_name.items()}


def plant_name(cell: Cell) -> str:
    """The environment and the disturbance of a cell."""
    return f"{cell.env} {cell.disturbance}"


def check_plants(path: Path, before: Plants, now: Plants) -> list[str]:
    """Compare the plants of the study in ``path`` with those of the same names now.

    Studies of earlier versions state fewer parts of their plants, or none; parts that are not
    stated count as the same.

    Returns:
        A line for each plant whose code computes something else now. Only its author can know
        whether this changes results.

    Raises:
        UserError: if a plant has other parameters, options, sizes or bounds now.
    """
    lines = []
    for name, plant in now.items():
        there = before.get(name, {})
        if changed := _changed(there, plant):
            raise UserError(
                f"{path} holds lanes of another plant with the name {name} ({changed}): register "
                "the changed plant under another name, or use another run directory"
            )
        if is_other_code(there.get(CODE), plant[CODE]):
            lines.append(
                f"warning: the code of {name} computes something else now than when {path} was "
                "begun, so results of two plants would stand side by side: use another run "
                "directory unless the change does not matter"
            )
    return lines


def differing_plants(before: Plants, now: Plants) -> list[str]:
    """A text for each plant that both have, and that is not the same in both."""
    found = []
    for name in before.keys() & now.keys():
        there, plant = before[name], now[name]
        if changed := _changed(there, plant):
            found.append(f"{name} ({changed})")
        elif is_other_code(there.get(CODE), plant.get(CODE)):
            found.append(f"{name} (its code)")
    return sorted(found)


class CheckedEnvironments:
    """Makes the environments of a study's cells; each plant is compared with the study once.

    Args:
        check: `rtd3jax.study.rundir.RunDirectory.check_plants`.
        say: receives a line for each plant whose code has changed.
    """

    def __init__(self, check: Callable[[Plants], list[str]], say: Callable[[str], None]) -> None:
        self._check, self._say = check, say
        self._found: dict[str, Any] = {}

    def of(self, cell: Cell) -> Any:
        """The environment of a cell; UserError if its plant is another one, or cannot be made."""
        name = plant_name(cell)
        if name not in self._found:
            try:
                for line in self._check(plants_of([cell])):
                    self._say(line)
                self._found[name] = cell.make_env()
            except UserError as error:
                self._found[name] = error
        if isinstance(self._found[name], UserError):
            raise UserError(str(self._found[name]))
        return self._found[name]


def _made(cell: Cell) -> dict[str, Any]:
    env = cell.make_env()
    params = env.default_params
    interface = describe(env, params)
    return {
        **plant_of(env, params),
        "observation": interface.observation_size,
        "actions": [interface.action_low.tolist(), interface.action_high.tolist()],
        NAMES: _names(params),
        CODE: code_of(env, params),
    }


def _names(params: object) -> list[str]:
    """The names of the numbers of an environment's parameters, such as ``env.mass``."""
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(params)]
    return [jax.tree_util.keystr(path).lstrip(".") for path in paths]


def _changed(before: dict[str, Any], now: dict[str, Any]) -> str:
    """The first difference of two plants but for their code, in words; "" if there is none."""
    compared = now.keys() & before.keys() - {CODE, NAMES}
    if all(same(before[part], now[part]) for part in compared):
        return ""
    return _difference(before, now, compared)


def _difference(before: dict[str, Any], now: dict[str, Any], parts: Iterable[str]) -> str:
    """The first difference of two plants in words, with the name of a parameter.

    A study of an earlier version does not state the names, or even the parameters.
    """
    own = now.get(NAMES) or before.get(NAMES) or []
    names = before.get(NAMES) or own
    if "params" in parts and len(names) == len(before["params"]) and len(own) == len(now["params"]):
        one = dict(zip(names, before["params"], strict=True))
        other = dict(zip(own, now["params"], strict=True))
        if not same(one, other):
            return difference(one, other)
    ordered = [part for part in now if part in parts]
    return difference({p: before[p] for p in ordered}, {p: now[p] for p in ordered})
