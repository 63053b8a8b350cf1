"""The spaces of a Gymnasium environment: its actions, and its observation as a vector."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable
from typing import Any

import gymnasium
import numpy as np

from rtd3jax.envs.compat.elements import kept_elements, time_limit
from rtd3jax.envs.entry import DEFAULT_STEP_LIMIT
from rtd3jax.errors import UserError

LARGEST = float(np.finfo(np.float32).max)
"""The largest number of an observation or a reward, which the compiled program gets in float32."""


@dataclasses.dataclass(frozen=True, eq=False)
class Surface:
    """The spaces of an environment, and the observed elements.

    Attributes:
        actions: the action space.
        names: a name for each element of the whole observation.
        keep: indices of the observed elements.
        limit: the time limit, in steps.
    """

    actions: gymnasium.spaces.Box
    names: tuple[str, ...]
    keep: tuple[int, ...]
    limit: int

    @functools.cached_property
    def indices(self) -> np.ndarray:
        """``keep`` as an array."""
        return np.asarray(self.keep)

    @functools.cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest action, float64."""
        return self.actions.low.astype(np.float64), self.actions.high.astype(np.float64)

    def command(self, action: np.ndarray) -> np.ndarray:
        """``action`` [A] within the bounds, with the shape and the dtype of the action space."""
        return within_bounds(action, *self.bounds, self.actions.dtype)

    def seen(self, flat: np.ndarray) -> np.ndarray:
        """The kept elements, float32 [O], of a flat observation."""
        return flat[self.indices].astype(np.float32)


def within_bounds(action: np.ndarray, low: np.ndarray, high: np.ndarray, dtype: Any) -> np.ndarray:
    """``action`` within the bounds (float64), with their shape and the given dtype.

    Elements of a whole dtype are rounded.
    """
    wide = action.astype(np.float64).reshape(low.shape)
    within = np.minimum(np.maximum(wide, low), high)
    if np.issubdtype(dtype, np.integer):
        within = np.rint(within)  # a cast alone would round towards zero
    return within.astype(dtype)


def surface_of(
    example: gymnasium.Env, title: str, keep: Iterable[int] | slice | None, limit: int | None
) -> tuple[Surface, Callable[[Any], np.ndarray]]:
    """The spaces of a Gymnasium environment, and a function that flattens its observations.

    Args:
        example: the environment.
        title: its name, for messages.
        keep: indices of the observed elements, or a slice; None for all.
        limit: the time limit in steps; None for the environment's own.

    Raises:
        UserError: for spaces that cannot be used for training, or an impossible ``keep`` or
            ``limit``.
    """
    actions, seen = example.action_space, example.observation_space
    if not isinstance(actions, gymnasium.spaces.Box):
        raise UserError(
            f"{title} has the actions {actions}; rtd3jax learns continuous ones: choose an "
            "environment whose action space is a bounded Box"
        )
    if not (np.isfinite(actions.low).all() and np.isfinite(actions.high).all()):
        raise UserError(
            f"{title} has unbounded actions: give them finite bounds, for example by "
            "gymnasium.wrappers.RescaleAction in a function that makes it"
        )
    names = tuple(_names(seen, "", title))
    size = len(names)
    indices = kept_elements(keep, size, title)
    if limit is None:
        spec = getattr(example, "spec", None)
        limit = getattr(spec, "max_episode_steps", None) or DEFAULT_STEP_LIMIT
    kept = np.asarray(indices)

    def read(observation: object) -> np.ndarray:
        flat = _flat(seen, observation)
        if flat.shape != (size,):
            raise ValueError(f"it has {flat.size} elements instead of {size}")
        # Elements that are not observed stay float64. `Simulator` finds infinite ones.
        large = [k for k in kept[np.abs(flat[kept]) > LARGEST] if math.isfinite(flat[k])]
        if large:
            raise ValueError(f"element {large[0]} is {flat[large[0]]:g}, too large for float32")
        return flat

    return Surface(actions, names, indices, time_limit(limit)), read


def _names(space: gymnasium.Space, name: str, title: str) -> Iterable[str]:
    if isinstance(space, gymnasium.spaces.Dict):
        for key, part in space.items():
            yield from _names(part, f"{name}.{key}" if name else str(key), title)
    elif isinstance(space, gymnasium.spaces.Tuple):
        for index, part in enumerate(space):
            yield from _names(part, f"{name}.{index}" if name else str(index), title)
    elif isinstance(space, gymnasium.spaces.Box):
        if space.dtype == np.uint8 or len(space.shape) > 2:
            raise UserError(
                f"{title} has images {space.shape} as observations; rtd3jax learns from vectors: "
                "put what they show into one, in a wrapper"
            )
        yield from (f"{name}[{k}]" if name else str(k) for k in range(math.prod(space.shape)))
    else:
        raise UserError(
            f"{title} has observations {space}; rtd3jax learns from a Box, or a Dict or Tuple of "
            "them: convert it in a wrapper (gymnasium.wrappers.TransformObservation)"
        )


def _flat(space: gymnasium.Space, observation: object) -> np.ndarray:
    parts: Any = observation
    if isinstance(space, gymnasium.spaces.Dict):
        return np.concatenate([_flat(part, parts[key]) for key, part in space.items()])
    if isinstance(space, gymnasium.spaces.Tuple):
        pairs = zip(space, parts, strict=True)
        return np.concatenate([_flat(part, value) for part, value in pairs])
    array = np.asarray(observation, np.float64)
    if array.shape != space.shape:
        raise ValueError(f"it has the shape {array.shape} instead of {space.shape}")
    return array.reshape(-1)
