"""Parts of the networks whose weights an update does not change: frozen parts, a waiting actor."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from rtd3jax.agents.memory.base import Params
from rtd3jax.agents.networks import LAYERS, Network
from rtd3jax.errors import UserError, nearest

State = TypeVar("State")
"""The state of a learner: a dataclass with networks and optimisers."""

Weights = Params | tuple[Params, ...]
"""The weights of one network, or of several networks of the same kind."""

WITH_THE_ACTOR = "target_actor", "actor_optimizer"
"""Fields of a learner's state that start with the actor, if it has them."""


def check_parts(parts: Sequence[str], networks: Mapping[str, Network]) -> None:
    """Raise UserError if a part does not name a network of ``networks`` or one of its layers."""
    for part in parts:
        whose, _, layer = part.partition(".")
        layers = [n for n in LAYERS if getattr(networks[whose], n, None) is not None]
        if layer and layer not in layers:
            raise UserError(
                f"freeze: {whose} has no layer {layer!r}{nearest(layer, layers)}; its layers are "
                f"{', '.join(layers)}"
            )


def check_fields(parts: Sequence[str], state: object, learner: str) -> None:
    """Raise UserError if the state of a learner has no field for the network of a part."""
    for whose in dict.fromkeys(part.partition(".")[0] for part in parts):
        if not hasattr(state, whose):
            raise UserError(
                f"freeze: the state of learner {learner!r} has no field {whose!r}, only "
                f"{', '.join(vars(state))}"
            )


def frozen_parts(before: State, after: State, parts: Sequence[str]) -> State:
    """The state ``after`` an update, in which ``parts`` keep their values ``before`` it."""
    if not parts:
        return after
    kept: dict[str, Weights] = {}
    for part in parts:
        whose, _, layer = part.partition(".")
        kept[whose] = _kept(getattr(before, whose), kept.get(whose, getattr(after, whose)), layer)
    changed: Any = after
    return dataclasses.replace(changed, **kept)


def waiting_actor(before: State, after: State, learns: jax.Array) -> State:
    """The learner's state ``after`` an update, with the actor of ``before`` unless it ``learns``.

    ``learns`` is a bool []. The fields in `WITH_THE_ACTOR` are treated as the actor is; all others
    are updated.
    """

    def either(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(learns, new, old)

    names = [name for name in ("actor", *WITH_THE_ACTOR) if hasattr(before, name)]
    kept = {n: jax.tree.map(either, getattr(after, n), getattr(before, n)) for n in names}
    changed: Any = after
    return dataclasses.replace(changed, **kept)


def _kept(before: Weights, after: Weights, layer: str) -> Weights:
    if not layer:
        return before
    if isinstance(before, tuple):
        assert isinstance(after, tuple)
        pairs = zip(before, after, strict=True)
        return tuple({**new, layer: old[layer]} for old, new in pairs)
    assert isinstance(after, dict)
    return {**after, layer: before[layer]}
