"""Parts of the networks whose weights stay as they began, such as ``actor.memory``."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from rtd3jax.agents.networks import Network
from rtd3jax.errors import UserError, nearest


def check_parts(parts: Sequence[str], networks: Mapping[str, Network]) -> None:
    """Raise UserError where a part names no network of ``networks``, or no layer of one."""
    for part in parts:
        whose, _, layer = part.partition(".")
        layers = [n for n in LAYERS if getattr(networks[whose], n, None) is not None]
        if layer and layer not in layers:
            raise UserError(
                f"freeze: {whose} has no layer {layer!r}{nearest(layer, layers)}; its layers are "
                f"{', '.join(layers)}"
            )


LAYERS = ("encoder", "memory", "current", "head", "output")


def frozen_parts(before: Any, after: Any, parts: Sequence[str]) -> Any:
    """The learner's state ``after`` an update, with ``parts`` as they were ``before`` it."""
    for part in parts:
        whose, _, layer = part.partition(".")
        kept = _kept(getattr(before, whose), getattr(after, whose), layer)
        after = dataclasses.replace(after, **{whose: kept})
    return after


def _kept(before: Any, after: Any, layer: str) -> Any:
    if not layer:
        return before
    if isinstance(after, dict):
        return {**after, layer: before[layer]}
    return tuple(_kept(*pair, layer) for pair in zip(before, after, strict=True))
