"""Parameters of environments and disturbances by name, as the commands write them."""

import ast
import dataclasses
import math
import numbers
import re
from typing import Any

from rtd3jax.errors import UserError, nearest


def parse_disturbance(text: str) -> tuple[str, dict[str, Any]]:
    """Parse ``"noise:sigma=1.0,reward_from=state"`` into a name and its parameters.

    A value is read as a Python literal (``elements=(0,1)``) if possible, else as a string.

    Raises:
        UserError: for a text of another form.
    """
    if not isinstance(text, str):
        raise UserError(f"a disturbance is a name such as 'none', not {text!r}")
    disturbance, _, rest = text.strip().partition(":")
    if not disturbance:
        raise UserError(f"disturbance {text!r} has no name; write for example noise:sigma=1.0")
    parameters: dict[str, Any] = {}
    # A comma within parentheses belongs to a value.
    for item in re.split(r",(?![^(]*\))", rest) if rest.strip() else []:
        name, equals, value = (part.strip() for part in item.partition("="))
        if not (name and equals and value):
            raise UserError(f"disturbance {text!r}: {item.strip()!r} is not of the form name=value")
        if name in parameters:
            raise UserError(f"disturbance {text!r} gives {name!r} twice")
        try:
            parameters[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            parameters[name] = value
    return disturbance.strip(), parameters


def assign(
    what: str, owners: tuple[Any, ...], parameters: dict[str, Any], also: tuple[str, ...] = ()
) -> tuple[Any, ...]:
    """Give each parameter to the first owner that has it; return the changed owners.

    ``also`` names parameters that are known but handled elsewhere, for the hint in the message.

    Raises:
        UserError: for a parameter that no owner has, or a value of the wrong type.
    """
    changes: list[dict[str, Any]] = [{} for _ in owners]
    fields = [settable(owner) for owner in owners]
    for name, value in parameters.items():
        for owned, change in zip(fields, changes, strict=True):
            if name in owned:
                change[name] = _coerce(what, name, value, owned[name])
                break
        else:
            if any(hasattr(owner, name) for owner in owners):
                raise UserError(
                    f"{what}: the parameter {name!r} is no plain number or tuple of whole numbers, "
                    f"so it cannot be set by name: pass params=env.default_params.replace(...)"
                )
            known = [*(field for owned in fields for field in owned), *also]
            raise UserError(
                f"{what} has no parameter {name!r}{nearest(name, known)} "
                f"(known: {', '.join(known)})"
            )
    return tuple(
        owner.replace(**change) if change else owner
        for owner, change in zip(owners, changes, strict=True)
    )


def settable(owner: object) -> dict[str, Any]:
    """The fields that can be set to a number or a tuple, with their defaults."""
    if not dataclasses.is_dataclass(owner):  # an environment's parameters may have any type
        return {}
    values = {field.name: getattr(owner, field.name) for field in dataclasses.fields(owner)}
    return {name: v for name, v in values.items() if isinstance(v, bool | int | float | tuple)}


def _coerce(what: str, name: str, value: object, default: bool | int | float | tuple) -> Any:
    """Convert ``value`` to the type of ``default``, or raise UserError."""
    wrong = f"{what}: {name}={value!r} must be"
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise UserError(f"{wrong} True or False")
        return value
    if isinstance(default, tuple):
        items = value if isinstance(value, list | tuple) else (value,)
        if not all(_is_integer(item) for item in items):
            raise UserError(f"{wrong} a list of whole numbers")
        return tuple(int(item) for item in items)
    if isinstance(default, int):
        if not isinstance(value, numbers.Integral) or isinstance(value, bool):
            raise UserError(f"{wrong} a whole number")
        return int(value)
    if not isinstance(value, numbers.Real) or isinstance(value, bool) or not math.isfinite(value):
        raise UserError(f"{wrong} a finite number")
    return float(value)


def _is_integer(value: object) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)
