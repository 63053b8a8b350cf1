"""The plants of a study: the same name must mean the same plant as long as the study grows."""

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib

from rtd3jax.envs.compat.simulated import is_simulated
from rtd3jax.envs.interface import describe, foreign_code
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.study.plan import Cell
from rtd3jax.system.jax_settings import random_key, with_settings
from rtd3jax.training.checkpoint import difference, same
from rtd3jax.training.plant import plant_of

Plants = dict[str, dict[str, Any]]
"""The identity of each pair of an environment and a disturbance, by `plant_name`."""

CODE = "code"
"""The part of an identity that identifies what the code of the environment computes."""

NAMES = "names"
"""The part of an identity that names its numbers, for messages."""


def plants_of(cells: Iterable[Cell]) -> Plants:
    """The plants of these cells, as their code makes them now."""
    first = {plant_name(cell): cell for cell in cells}
    return {name: _made(cell) for name, cell in first.items()}


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
        compared = plant.keys() & there.keys() - {CODE, NAMES}
        here = {part: plant[part] for part in plant if part in compared}
        was = {part: there[part] for part in here}
        if not same(was, here):
            raise UserError(
                f"{path} holds lanes of another plant with the name {name} "
                f"({_named_difference(was, here, plant[NAMES])}): choose another directory, or "
                "register the changed plant under another name"
            )
        if _is_other_code(there.get(CODE), plant[CODE]):
            lines.append(
                f"warning: the code of {name} computes something else now than when {path} was "
                "begun, so one table can show results of two plants: choose another directory "
                "unless the change does not matter"
            )
    return lines


def _made(cell: Cell) -> dict[str, Any]:
    env = cell.make_env()
    params = env.default_params
    interface = describe(env, params)
    return {
        **plant_of(env, params),
        "observation": interface.observation_size,
        "actions": [interface.action_low.tolist(), interface.action_high.tolist()],
        NAMES: _names(params),
        CODE: _code_of(env, params),
    }


def _names(params: object) -> list[str]:
    """The names of the numbers of an environment's parameters, such as ``env.mass``."""
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(params)]
    return [jax.tree_util.keystr(path).lstrip(".") for path in paths]


def _named_difference(was: dict[str, Any], here: dict[str, Any], names: list[str]) -> str:
    """The first difference of two plants in words, with the name of a parameter."""
    before, now = was.get("params", []), here.get("params", [])
    if len(before) == len(now) == len(names):
        for name, one, other in zip(names, before, now, strict=True):
            if not same(one, other):
                return f"{name}: {difference(one, other)}"
    return difference(was, here)


def _is_other_code(before: dict[str, str] | None, now: dict[str, str] | None) -> bool:
    """Whether two codes differ; another version of JAX may write the same code differently."""
    if before is None or now is None or before["jax"] != now["jax"]:
        return False
    return before["sha256"] != now["sha256"]


def _code_of(env: EnvironmentLike, params: object) -> dict[str, str] | None:
    """A digest of the operations of reset and step, without the numbers of the parameters.

    Nothing is compiled. The result is None for an environment that calls Python while it runs: the
    digest would not cover this Python code, and would differ in every process.
    """
    if is_simulated(env):
        return None

    def both(key: jax.Array, state: object, action: jax.Array, params: object) -> tuple:
        return env.reset(key, params), env.step(key, state, action, params)

    shape = env.action_space(params).shape
    # The text must not depend on the settings of the process, nor on its devices.
    with with_settings(()), foreign_code(), jax.disable_jit(False):
        key = random_key(0)
        state = jax.eval_shape(env.reset, key, params)[1]
        action = jax.ShapeDtypeStruct(shape, jnp.float32)
        traced = jax.jit(both).trace(key, state, action, params)
        text = traced.lower(lowering_platforms=("cpu",)).as_text()
    if "callback" in text:
        return None
    versions = f"{jax.__version__}, jaxlib {jaxlib.__version__}"
    return {"jax": versions, "sha256": hashlib.sha256(text.encode()).hexdigest()}
