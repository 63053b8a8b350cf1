"""Calls from a compiled program to a function on the host."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback
from jax.experimental.buffer_callback import Buffer, buffer_callback
from jax.typing import ArrayLike

from rtd3jax.errors import UserError


def host_call(
    host: Callable[..., tuple],
    shapes: tuple[tuple[tuple[int, ...], Any], ...],
    due: Callable[[jax.Array], jax.Array] | None,
    *arguments: jax.Array,
    most: int | None = None,
) -> tuple[jax.Array, ...]:
    """Call a function on the host from a compiled program.

    Under vmap, one call from the program runs ``host`` for all members, one after the other.

    Args:
        host: a function of numpy arrays that returns a tuple of arrays.
        shapes: shape and dtype of each array that ``host`` returns.
        due: a function of the first argument, with the axes of vmap, that returns a bool []. If it
            is false, ``host`` is not called, and the results are zeros. None means always true.
        *arguments: the arguments of ``host``.
        most: the largest number of simulators, if each member under vmap needs one.

    Raises:
        UserError: for more members, when the program is traced.
    """
    arguments = tuple(map(jnp.asarray, arguments))
    ranks = [argument.ndim for argument in arguments]
    dtypes = [argument.dtype for argument in arguments]

    def on_host(*arrays: np.ndarray) -> tuple[ArrayLike, ...]:
        lead = arrays[0].shape[: arrays[0].ndim - ranks[0]]
        if not lead:
            return host(*arrays)
        flat = [a.reshape(-1, *a.shape[len(lead) :]) for a in arrays]
        answers = [host(*row) for row in zip(*flat, strict=True)]
        columns = zip(*answers, strict=True)
        return tuple(
            np.stack(column).reshape(*lead, *shape).astype(dtype)
            for column, (shape, dtype) in zip(columns, shapes, strict=True)
        )

    @jax.custom_batching.custom_vmap
    def call(*given: jax.Array) -> tuple[jax.Array, ...]:
        lead = given[0].shape[: given[0].ndim - ranks[0]]
        _check_members(math.prod(lead), most)
        results = tuple(jax.ShapeDtypeStruct((*lead, *shape), dtype) for shape, dtype in shapes)

        def ask(*given: jax.Array) -> tuple[jax.Array, ...]:
            return _ask(on_host, results, *given)

        if due is None:
            return ask(*given)

        def skip(*given: jax.Array) -> tuple[jax.Array, ...]:
            return tuple(jnp.zeros(result.shape, result.dtype) for result in results)

        return jax.lax.cond(due(given[0]), ask, skip, *given)

    @call.def_vmap
    def _side_by_side(size: int, batched: list[bool], *given: jax.Array) -> tuple:
        wide = []
        for array, dtype, is_batched in zip(given, dtypes, batched, strict=True):
            known = jnp.asarray(array, dtype)  # a constant may come as a Python number
            wide.append(known if is_batched else jnp.broadcast_to(known, (size, *known.shape)))
        return call(*wide), tuple(True for _ in shapes)

    return call(*arguments)


def _check_members(members: int, most: int | None) -> None:
    """Raise UserError for more members than simulators.

    Each step would take the simulators of other members, and replay all episodes from their start.
    """
    if most is not None and members > most:
        raise UserError(
            f"simulators play at most {most:,} episodes together, not {members:,}: lower "
            "eval_episodes or environments, or vmap over fewer keys"
        )


def _ask(
    on_host: Callable[..., tuple[ArrayLike, ...]],
    results: tuple[jax.ShapeDtypeStruct, ...],
    *given: jax.Array,
) -> tuple[jax.Array, ...]:
    """Call ``on_host`` once; it must not keep its arguments.

    On a CPU, the arrays are read and written in place. `io_callback` would first make a device
    array of every argument, which takes twenty times as long as the rest of the call.
    """

    def in_place(context: object, out: Sequence[Buffer], *given: Buffer) -> None:
        answers = on_host(*map(np.asarray, given))
        for buffer, answer in zip(out, answers, strict=True):
            np.asarray(buffer)[...] = answer

    def copied(*given: jax.Array) -> tuple[np.ndarray, ...]:
        answers = zip(on_host(*map(np.asarray, given)), results, strict=True)
        return tuple(np.asarray(answer, result.dtype) for answer, result in answers)

    def on_cpu(*given: jax.Array) -> tuple[jax.Array, ...]:
        return tuple(buffer_callback(in_place, results, has_side_effect=True)(*given))

    def elsewhere(*given: jax.Array) -> tuple[jax.Array, ...]:
        return tuple(io_callback(copied, results, *given))

    return jax.lax.platform_dependent(*given, cpu=on_cpu, default=elsewhere)
