"""Stresses: disturbances and changes of a plant whose strength a test of robustness varies."""

import dataclasses
import math
import numbers
import re
from collections.abc import Callable
from typing import Any

from flax import struct

from rtd3jax.envs.processes.disturbances import GaussianNoise
from rtd3jax.envs.processes.faults import Dropout
from rtd3jax.envs.processes.impairment import SHORTEST_QUEUE, Impairment, VariableDelay
from rtd3jax.errors import UserError

FACTORS = (0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
"""Factors by which a test of robustness multiplies a parameter of the plant [choice]."""


@dataclasses.dataclass(frozen=True)
class Stress:
    """One stress with the values of its strength; see `rtd3jax.robustness`.

    Attributes:
        name: letters, digits, "-", "." and "_".
        values: values of the strength, at least one.
        change: a function ``(params, value)``, where ``params`` are the parameters of the plant
            without its disturbances. It returns changed parameters; or a process of the
            observation, or a pair ("observation" or "action", process), which acts between the
            environment and the policy; or another environment. If the results for all values have
            the same pytree structure, one compiled program serves all values.
        quantity: what ``value`` is, with its unit; the label of the axis. The name by default.

    Raises:
        UserError: for an unusable name, values that are not finite numbers, or no function.
    """

    name: str
    values: tuple[float, ...]
    change: Callable[[Any, Any], Any]
    quantity: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not re.fullmatch(r"[\w.-]+", self.name):
            raise UserError(
                f"a stress cannot be called {self.name!r}; choose a name of letters, digits, '-', "
                "'.' and '_'"
            )
        if not callable(self.change):
            raise UserError(f"stress {self.name}: change must be a function, not {self.change!r}")
        values = tuple(self.values) if isinstance(self.values, list | tuple) else ()
        if not values or not all(map(_is_number, values)):
            raise UserError(
                f"stress {self.name}: values={self.values!r} must be a tuple of finite numbers"
            )
        object.__setattr__(self, "values", tuple(dict.fromkeys(values)))  # each value once
        object.__setattr__(self, "quantity", self.quantity or self.name)


def _is_number(value: object) -> bool:
    is_real = isinstance(value, numbers.Real) and not isinstance(value, bool)
    return is_real and math.isfinite(float(value))  # type: ignore[arg-type]


def factor_stress(parameter: str) -> Stress:
    """The stress that multiplies a positive parameter of the plant by 0.5 to 2."""

    def scale(params: struct.PyTreeNode, factor: float) -> object:
        if factor <= 0:
            raise UserError(f"{parameter}-factor={factor:g} must be greater than 0")
        return params.replace(**{parameter: float(factor) * getattr(params, parameter)})

    return Stress(f"{parameter}-factor", FACTORS, scale, f"factor of {parameter}")


def _noise(params: object, sigma: float) -> Impairment:
    return Impairment(noise=GaussianNoise(float(sigma)))


def _dropout(params: object, p: float) -> Impairment:
    return Impairment(dropout=Dropout(float(p)))


def _delay(params: object, steps: float) -> Impairment:
    if steps != int(steps):
        raise UserError(f"a delay of {steps:g} steps must be a whole number")
    # The length of the queue is a power of two, so that few programs serve all longer delays.
    longest = max(SHORTEST_QUEUE, 1 << (max(int(steps), 1) - 1).bit_length())
    return Impairment(delay=VariableDelay(int(steps), longest=longest))


def _action_delay(params: object, steps: float) -> tuple[str, Impairment]:
    return "action", _delay(params, steps)


SIGNAL_STRESSES: tuple[Stress, ...] = (
    Stress("noise", (0.0, 0.1, 0.25, 0.5, 1.0, 1.5, 2.0), _noise, "sigma of the noise"),
    Stress("delay", (0, 1, 2, 3, 4, 6, 8), _delay, "delay of the observation in steps"),
    Stress("dropout", (0.0, 0.1, 0.2, 0.4, 0.6, 0.8), _dropout, "probability of a lost reading"),
    Stress("action-delay", (0, 1, 2, 3, 4, 6, 8), _action_delay, "delay of the action in steps"),
)
"""Stresses of the observation and the action, which fit any environment; the values are [choice].
The noise is in the units of the observation."""
