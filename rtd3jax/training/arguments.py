"""Checks of arguments that `rtd.train` and `rtd.Study` have in common."""

import os
from collections.abc import Iterable
from typing import Any

import numpy as np

from rtd3jax.errors import UserError
from rtd3jax.system.numbers import is_whole
from rtd3jax.training.devices import default_strategy


def check_seeds(seeds: Iterable[int]) -> tuple[int, ...]:
    """The seeds as integers; UserError for no seeds, equal seeds, or seeds outside [0, 2**32)."""
    listed = as_list(seeds)
    if listed is None:
        raise UserError(f"seeds must be a sequence of integers such as range(5), not {seeds!r}")
    seeds = tuple(listed)
    for seed in seeds:
        if not is_whole(seed) or not 0 <= seed < 2**32:
            raise UserError(f"seeds must be integers from 0 to 2**32 - 1, not {seed!r}")
    if not seeds or len(set(seeds)) < len(seeds):
        raise UserError(f"seeds must be distinct and at least one, not {list(seeds)}")
    return tuple(int(seed) for seed in seeds)


def as_list(values: object) -> list[Any] | None:
    """The values of something that can be iterated over; None for anything else."""
    return list(values) if isinstance(values, Iterable) else None


def check_checkpoints(directory: object, seconds: object) -> None:
    """Raise UserError unless these are a path, and a time in seconds; both may be None."""
    if not (directory is None or isinstance(directory, str | os.PathLike)):
        raise UserError(f"checkpoint_dir must be a path, not {directory!r}")
    if seconds is None:
        return
    number = float(seconds) if isinstance(seconds, float | int | np.number) else -1.0
    if isinstance(seconds, bool) or not number >= 0:  # also NaN
        raise UserError(f"checkpoint_seconds must be a number of at least 0, not {seconds!r}")


def check_strategy(strategy: str | None) -> str:
    """The strategy; by default the one for the backend."""
    if strategy not in (None, "map", "vmap"):
        raise UserError(f"strategy must be 'map' or 'vmap', not {strategy!r}")
    return strategy or default_strategy()
