"""The arrays in a checkpoint: the leaves of a lane's state by their paths in it."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.envs.compat.simulated import release
from rtd3jax.errors import UserError
from rtd3jax.training.lane import Lane, LaneState
from rtd3jax.training.loop import Program


def to_arrays(state: LaneState) -> dict[str, np.ndarray]:
    """The leaves by their paths in the state; typed keys as their data."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path): _to_array(leaf) for path, leaf in leaves}


def from_arrays(
    arrays: dict[str, np.ndarray], program: Program, lane: Lane, file: Path
) -> LaneState:
    """The state from the arrays of `to_arrays`, checked against the program's state."""
    return leaves_from_arrays(jax.eval_shape(program.init, lane), arrays, "", file)


def leaves_from_arrays(expected: Any, arrays: dict[str, np.ndarray], place: str, file: Path) -> Any:
    """A part of a state with the structure of ``expected``, from the arrays under ``place``.

    With an empty ``place``, it is the whole state.

    Raises:
        UserError: when the arrays under ``place`` do not have this structure.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(expected)
    named = [(place + jax.tree_util.keystr(path), leaf) for path, leaf in leaves]
    there = {name for name in arrays if not place or name.startswith((f"{place}.", f"{place}["))}
    if odd := sorted(there ^ {name for name, _ in named}):
        raise UserError(f"{file} does not fit this agent: array {odd[0]} is missing or unexpected")
    return jax.tree.unflatten(
        structure, [_from_array(arrays[name], leaf, name, file) for name, leaf in named]
    )


def extended(arrays: dict[str, np.ndarray], program: Program, lane: Lane) -> dict[str, np.ndarray]:
    """Arrays of a lane that has more steps now, extended with the values of a new lane."""

    def longer(lane: Lane) -> dict[str, jax.Array]:
        state = program.init(lane)
        release(program.env, state.env_state)  # nobody plays the episodes that begin here
        leaves = jax.tree_util.tree_leaves_with_path(state)
        named = {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
        return {
            name: leaf
            for name, leaf in named.items()
            if name in arrays and not _is_key(leaf) and _is_head(arrays[name].shape, leaf.shape)
        }

    tails = {n: np.asarray(leaf)[len(arrays[n]) :] for n, leaf in jax.jit(longer)(lane).items()}
    return {
        name: np.concatenate([array, tails[name]]) if name in tails else array
        for name, array in arrays.items()
    }


def _is_head(short: tuple[int, ...], long: tuple[int, ...]) -> bool:
    """Whether an array of shape ``short`` can be the beginning of an array of shape ``long``."""
    return len(short) == len(long) > 0 and short[0] < long[0] and short[1:] == long[1:]


def _is_key(leaf: jax.Array) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _to_array(leaf: jax.Array) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _from_array(array: np.ndarray, leaf: jax.Array, name: str, file: Path) -> jax.Array:
    if _is_key(leaf):
        dtype: Any = leaf.dtype
        value = jax.random.wrap_key_data(jnp.asarray(array), impl=dtype._impl.name)
    else:
        value = jnp.asarray(array)
    if value.shape != leaf.shape or value.dtype != leaf.dtype:
        raise UserError(
            f"{file} does not fit this agent: array {name} is {value.dtype}{list(value.shape)}, "
            f"not {leaf.dtype}{list(leaf.shape)}"
        )
    return value
