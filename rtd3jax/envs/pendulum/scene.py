"""Draws the pendulum in the frames of an episode: the rod, and the torque as an arc."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from gymnax.environments.classic_control.pendulum import EnvParams as PendulumParams
from gymnax.environments.classic_control.pendulum import EnvState as PendulumState

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class PendulumScene:
    """See `rtd3jax.envs.scene.Scene`."""

    def __init__(self, params: PendulumParams) -> None:
        self._limit = float(params.max_torque)

    def first(self, state: PendulumState) -> np.ndarray:
        """(cos theta, sin theta, theta dot)."""
        return np.array([np.cos(state.theta), np.sin(state.theta), state.theta_dot])

    def draw(
        self, axes: "Axes", observations: Sequence[np.ndarray], actions: Sequence[np.ndarray]
    ) -> None:
        """Draw the rod at the angle of the last observation, and the last torque."""
        cos, sin = observations[-1][:2]
        axes.plot([0.0, -sin], [0.0, cos], color="#0072B2", linewidth=7, solid_capstyle="round")
        axes.plot([0.0], [0.0], "o", color="#333333", markersize=5)
        torque = float(actions[-1][0]) if actions else 0.0
        share = np.clip(torque / self._limit, -1.0, 1.0)
        angles = np.linspace(0.0, np.pi * share, 30) + np.pi / 2
        axes.plot(1.15 * np.cos(angles), 1.15 * np.sin(angles), color="#E69F00", linewidth=3)
        axes.set(xlim=(-1.3, 1.3), ylim=(-1.3, 1.3), aspect="equal")
        axes.axis("off")
        axes.set_title(f"torque {torque:+.2f} N m", fontsize=8)
