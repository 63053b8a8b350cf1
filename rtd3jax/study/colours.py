"""The agents' colours and order in pictures and on pages."""

from collections.abc import Iterable

from rtd3jax.registries import AGENTS

OTHER_COLOUR = "#56B4E9"
"""Of an agent that states no colour of its own, or is not registered here."""


def colour_of(algorithm: str, *, on_dark: bool = False) -> str:
    """The colour of an agent's curves, on a light page or on a dark one."""
    if algorithm not in AGENTS:
        return OTHER_COLOUR
    variant = AGENTS[algorithm]
    light = variant.colour or OTHER_COLOUR
    return variant.colour_on_dark or light if on_dark else light


def ordered(algorithms: Iterable[str]) -> list[str]:
    """Distinct trained agents in the order in which they were registered, unknown ones last."""
    known = list(AGENTS)
    return sorted(set(algorithms), key=lambda n: (known.index(n) if n in AGENTS else len(known), n))
