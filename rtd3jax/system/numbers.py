"""Checks of numbers that users give, and the standard error of a mean."""

import math
from typing import Any

import numpy as np

from rtd3jax.errors import UserError


def is_whole(value: Any) -> bool:
    """Whether ``value`` is a whole number: an integer, or a float such as 3.0, but not a bool."""
    try:
        return not isinstance(value, bool) and bool(value == int(value))
    except (TypeError, ValueError, OverflowError):
        return False


def is_integer(value: Any) -> bool:
    """Whether ``value`` is an integer of Python or numpy: no bool, and no float such as 3.0."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def check_count(name: str, value: Any, low: int) -> None:
    """Raise UserError, which names the value, unless it is an integer from ``low`` to 2**32 - 1."""
    if not is_whole(value) or not low <= value < 2**32:
        high = " and less than 2**32" if is_whole(value) and value >= low else ""
        raise UserError(f"{name} must be an integer of at least {low}{high}, not {value!r}")


def check_counts(episodes: int, seed: int, name_of_episodes: str = "episodes") -> None:
    """Raise UserError for an impossible number of episodes or an impossible seed."""
    check_count(name_of_episodes, episodes, 1)
    check_count("seed", seed, 0)


def standard_error(values: np.ndarray) -> float:
    """The standard error of the mean of independent values [N]; NaN for a single value."""
    return float(values.std(ddof=1) / np.sqrt(values.size)) if values.size > 1 else math.nan
