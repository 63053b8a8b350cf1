"""Draws the rover in the frames of an episode: its path and the path of the target."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEP_SECONDS = 0.1
"""Assumed length of a rover's step in seconds, as in the pictures of the documentation."""


class Target(Protocol):
    """The parameters of the rover that are drawn."""

    @property
    def target_speed(self) -> float:
        """m/s."""

    @property
    def target_yaw_rate(self) -> float:
        """rad/s."""


class RoverScene:
    """See `rtd3jax.envs.scene.Scene`."""

    def __init__(self, params: Target) -> None:
        self._target = np.array([params.target_speed, params.target_yaw_rate], np.float64)

    def first(self, state: object) -> np.ndarray:
        """The errors at rest; the path begins with the next motion."""
        return -self._target

    def draw(
        self, axes: "Axes", observations: Sequence[np.ndarray], actions: Sequence[np.ndarray]
    ) -> None:
        """Draw the path so far, the rover at its end, and the path of the target."""
        # The rover starts at rest; the other rows are the motions of the steps.
        motion = np.array(observations[1:]).reshape(-1, 2) + self._target
        path, heading = _path(motion)
        wanted, _ = _path(np.tile(self._target, (max(len(motion), 50), 1)))
        axes.plot(*wanted.T, color="#999999", linestyle="--", linewidth=1)
        axes.plot(*path.T, color="#009E73", linewidth=1.5)
        nose = path[-1] + 0.3 * np.array([np.cos(heading), np.sin(heading)])
        axes.plot(*np.stack((path[-1], nose)).T, color="#333333", linewidth=3)
        axes.plot(*path[-1], "o", color="#009E73", markersize=8)
        places = np.concatenate((path, wanted))
        middle, reach = (places.max(0) + places.min(0)) / 2, max(1.0, np.ptp(places, axis=0).max())
        for axis, centre in zip("xy", middle, strict=True):
            axes.set(**{f"{axis}lim": (centre - 0.6 * reach, centre + 0.6 * reach)})
        axes.set_aspect("equal")
        axes.tick_params(labelsize=6)
        axes.set_title("path in metres; dashed: target", fontsize=8)


def _path(motion: np.ndarray) -> tuple[np.ndarray, float]:
    """Positions [T + 1, 2] in m and the last heading, from speeds and yaw rates [T, 2]."""
    heading = np.cumsum(motion[:, 1]) * STEP_SECONDS
    velocity = motion[:, :1] * np.stack((np.cos(heading), np.sin(heading)), axis=1)
    places = np.concatenate((np.zeros((1, 2)), np.cumsum(velocity, axis=0) * STEP_SECONDS))
    return places, float(heading[-1]) if len(heading) else 0.0
