"""Draws frames of an episode, for Gymnasium's ``render_mode="rgb_array"``.

The left side shows the plant, as the page of a study draws it (pendulum, rover). The right side
shows the observations and actions so far. For an environment without a drawing, the frame only
shows these signals. matplotlib is imported when the first frame is drawn.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from rtd3jax.envs.pendulum.environment import Pendulum
from rtd3jax.envs.rover.environment import Rover
from rtd3jax.protocols import EnvironmentLike

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE = (640, 360)
"""Width and height of every frame in pixels."""
_DPI = 100
_SHOWN = 200
"""Number of the last steps whose signals a frame shows."""
_ELEMENTS = 8
"""Elements of a signal that are drawn, at most."""
_ROVER_SECONDS = 0.1
"""Assumed length of a rover's step in seconds, as in the pictures of the documentation."""


class Episode:
    """Records an episode and draws its frames.

    Args:
        env: the environment.
        params: the environment's parameters.
    """

    def __init__(self, env: EnvironmentLike, params: object) -> None:
        self._params: Any
        while hasattr(env, "base"):  # the wrapped environment
            env, params = env.base, getattr(params, "env", params)
        self._plant, self._params = env, params
        self._figure: Any = None
        self.begin(np.zeros(0), None)

    def begin(self, observation: np.ndarray, state: Any) -> None:
        """Begin a new episode with its first ``observation`` [...] and ``state``."""
        while hasattr(state, "env"):
            state = state.env
        self._seen = [np.ravel(observation)]
        self._true = [_first_truth(self._plant, state)]
        self._actions: list[np.ndarray] = []
        self._rewards: list[float] = []

    def add(
        self, action: np.ndarray, observation: np.ndarray, reward: float, info: dict[str, Any]
    ) -> None:
        """Record a step: the action, the observation after it, and the reward."""
        self._actions.append(np.ravel(np.asarray(action, np.float64)))
        self._seen.append(np.ravel(observation))
        self._true.append(np.ravel(info.get("true_observation", observation)))
        self._rewards.append(float(reward))

    def frame(self) -> np.ndarray:
        """The frame of the last step: uint8 [height, width, 3]."""
        if self._figure is None:
            self._figure = _Figure(isinstance(self._plant, Pendulum | Rover))
        figure = self._figure
        figure.clear()
        if isinstance(self._plant, Pendulum):
            self._draw_pendulum(figure.plant)
        elif isinstance(self._plant, Rover):
            self._draw_rover(figure.plant)
        first = max(0, len(self._rewards) - _SHOWN)
        times = np.arange(first, len(self._rewards) + 1)
        _signals(figure.seen, "seen", times, self._seen[first:])
        _signals(figure.done, "action", times[1:], self._actions[first:])
        rewards = [np.array([reward]) for reward in self._rewards[first:]]
        _signals(figure.earned, "reward", times[1:], rewards)
        figure.earned.set_xlabel("step", fontsize=7)
        return figure.pixels()

    def _draw_pendulum(self, axes: "Axes") -> None:
        cos, sin = self._true[-1][:2]
        axes.plot([0.0, -sin], [0.0, cos], color="#0072B2", linewidth=7, solid_capstyle="round")
        axes.plot([0.0], [0.0], "o", color="#333333", markersize=5)
        torque = float(self._actions[-1][0]) if self._actions else 0.0
        limit = float(self._params.max_torque)
        share = np.clip(torque / limit, -1.0, 1.0)
        angles = np.linspace(0.0, np.pi * share, 30) + np.pi / 2
        axes.plot(1.15 * np.cos(angles), 1.15 * np.sin(angles), color="#E69F00", linewidth=3)
        axes.set(xlim=(-1.3, 1.3), ylim=(-1.3, 1.3), aspect="equal")
        axes.axis("off")
        axes.set_title(f"torque {torque:+.2f} N m", fontsize=8)

    def _draw_rover(self, axes: "Axes") -> None:
        target = np.array([self._params.target_speed, self._params.target_yaw_rate], np.float64)
        # The rover starts at rest; the other rows are the motions of the steps.
        motion = np.array(self._true[1:]).reshape(-1, 2) + target
        path, heading = _path(motion)
        wanted, _ = _path(np.tile(target, (max(len(motion), 50), 1)))
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


class _Figure:
    """A figure that is cleared and drawn again for each frame; only its axes are kept."""

    def __init__(self, plant: bool) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        width, height = SIZE
        figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
        self._canvas = FigureCanvasAgg(figure)
        left = 0.56 if plant else 0.09
        self.plant = figure.add_axes((0.05, 0.07, 0.42, 0.84)) if plant else None
        self.seen, self.done, self.earned = (
            figure.add_axes((left, bottom, 0.97 - left, 0.22)) for bottom in (0.71, 0.41, 0.11)
        )
        self._axes = figure.axes

    def clear(self) -> None:
        for axes in self._axes:
            axes.clear()

    def pixels(self) -> np.ndarray:
        self._canvas.draw()
        return np.array(self._canvas.buffer_rgba())[:, :, :3]


def _signals(axes: "Axes", name: str, times: np.ndarray, rows: list[np.ndarray]) -> None:
    if rows and rows[0].size:
        axes.plot(times, np.stack(rows)[:, :_ELEMENTS], linewidth=1)
    axes.set_title(name, fontsize=7, loc="left", pad=2)
    axes.tick_params(labelsize=6)


def _first_truth(plant: object, state: Any) -> np.ndarray:
    """The undisturbed first observation, for plants that have a drawing."""
    if isinstance(plant, Pendulum) and state is not None:
        return np.array([np.cos(state.theta), np.sin(state.theta), state.theta_dot])
    return np.zeros(2)


def _path(motion: np.ndarray) -> tuple[np.ndarray, float]:
    """Positions [T + 1, 2] in m and the last heading, from speeds and yaw rates [T, 2]."""
    heading = np.cumsum(motion[:, 1]) * _ROVER_SECONDS
    velocity = motion[:, :1] * np.stack((np.cos(heading), np.sin(heading)), axis=1)
    places = np.concatenate((np.zeros((1, 2)), np.cumsum(velocity, axis=0) * _ROVER_SECONDS))
    return places, float(heading[-1]) if len(heading) else 0.0
