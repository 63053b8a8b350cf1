"""`Scene` draws a plant in the frames of an episode, next to its signals.

An environment provides it by a method ``scene(params) -> Scene``.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Scene(Protocol):
    """The drawing of a plant with given parameters."""

    def first(self, state: Any, /) -> np.ndarray:
        """The undisturbed observation [O] of an episode's first ``state``."""

    def draw(
        self, axes: "Axes", observations: Sequence[np.ndarray], actions: Sequence[np.ndarray], /
    ) -> None:
        """Draw the last step.

        Args:
            axes: empty axes of matplotlib.
            observations: undisturbed observations [O]: the first one, and one after each action.
            actions: actions [A]; empty before the first step.
        """


def scene_of(env: object, params: object) -> Scene | None:
    """The scene of an environment; None if it has none."""
    make = getattr(env, "scene", None)
    return make(params) if callable(make) else None
