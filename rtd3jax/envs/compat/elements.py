"""Checks of a user's choices for a wrapped environment: the observed elements and a time limit."""

from collections.abc import Iterable
from typing import Any

from rtd3jax.errors import UserError
from rtd3jax.system.numbers import is_whole


def kept_elements(keep: Iterable[int] | slice | None, size: int, name: str) -> tuple[int, ...]:
    """Indices of the observed elements.

    Args:
        keep: the indices, or a slice; None for all.
        size: the number of elements of the whole observation.
        name: the environment's name, for messages.

    Raises:
        UserError: unless the indices are distinct integers from 0 to ``size`` - 1, at least one.
    """
    every = range(size)
    if keep is None or isinstance(keep, slice):
        indices = list(every if keep is None else every[keep])
    else:
        indices = list(keep) if isinstance(keep, Iterable) else [keep]
    if not all(is_whole(index) for index in indices):
        raise UserError(f"keep={keep!r} must be a list of indices, or a slice")
    if not indices or len(set(indices)) < len(indices) or min(indices) < 0:
        raise UserError(f"keep={keep!r} must name distinct elements, not negative, at least one")
    if max(indices) >= size:
        raise UserError(f"keep={max(indices)} is not in {name}'s observation of size {size}")
    return tuple(int(index) for index in indices)


def time_limit(limit: Any) -> int:
    """The time limit of an episode in steps; UserError unless it is an integer of at least 1."""
    if not is_whole(limit) or int(limit) < 1:
        raise UserError(f"max_steps_in_episode={limit!r} must be an integer of at least 1")
    return int(limit)
