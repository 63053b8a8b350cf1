"""Colours and order of the agents in figures and on pages."""

from collections.abc import Iterable

from rtd3jax.registries import AGENTS

OTHER_COLOUR = "#A6761D"
"""Colour of an agent that defines no colour, or is not registered."""


def colour_of(algorithm: str, *, on_dark: bool = False) -> str:
    """The colour of an agent's curves, on a light page or on a dark one."""
    if algorithm not in AGENTS:
        return OTHER_COLOUR
    variant = AGENTS[algorithm]
    light = variant.colour or OTHER_COLOUR
    return variant.colour_on_dark or light if on_dark else light


def ordered(algorithms: Iterable[str]) -> list[str]:
    """The distinct names in the order of registration; unregistered agents come last."""
    known = list(AGENTS)
    return sorted(set(algorithms), key=lambda n: (known.index(n) if n in AGENTS else len(known), n))
