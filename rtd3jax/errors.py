"""The error for mistakes that the user can correct."""

import difflib
from collections.abc import Iterable, Sequence


class UserError(ValueError):
    """An error whose message is one clear line for the user."""


def nearest(word: str, choices: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the choice most like ``word``, or ``""`` if none is."""
    matches = difflib.get_close_matches(str(word), [str(c) for c in choices], n=1)
    return f"; did you mean {matches[0]!r}?" if matches else ""


def check_choice(name: str, value: object, choices: Sequence[str]) -> None:
    """Raise UserError unless ``value`` is one of the choices."""
    if value not in choices:
        raise UserError(
            f"{name} {value!r} is unknown{nearest(str(value), choices)}; choose "
            f"{' or '.join(choices)}"
        )


def typed_reason(error: BaseException) -> str:
    """The error's type, then `short_reason`; for errors that code of others raised."""
    reason, name = short_reason(error), type(error).__name__
    return reason if reason == name else f"{name}: {reason}"


def short_reason(error: BaseException) -> str:
    """The most informative line of an error's message, or the error's type if it has no message.

    This is the first line. If the message begins with a traceback, as messages of host callbacks
    do, it is the last line.
    """
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[-1].strip() if "Traceback (most recent call last)" in lines[0] else lines[0]
