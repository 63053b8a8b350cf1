"""Checks of numbers that users give."""

from typing import Any


def is_whole(value: Any) -> bool:
    """Whether ``value`` is a whole number: an integer, or a float such as 3.0, but not a bool."""
    try:
        return not isinstance(value, bool) and bool(value == int(value))
    except (TypeError, ValueError, OverflowError):
        return False
