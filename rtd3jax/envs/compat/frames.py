"""Draws frames of an episode, for Gymnasium's ``render_mode="rgb_array"``.

The left side shows the plant, drawn by the environment's `rtd3jax.envs.scene.Scene`. The right side
shows the observations and actions so far. For an environment without a scene, the frame only shows
these signals. matplotlib is imported when the first frame is drawn.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from rtd3jax.envs.scene import scene_of
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


class Episode:
    """Records an episode and draws its frames.

    Args:
        env: the environment.
        params: the environment's parameters.
    """

    def __init__(self, env: EnvironmentLike, params: object) -> None:
        while hasattr(env, "base"):  # the wrapped environment
            env, params = env.base, getattr(params, "env", params)
        self._scene = scene_of(env, params)
        self._figure: Any = None
        self.begin(np.zeros(0), None)

    def begin(self, observation: np.ndarray, state: Any) -> None:
        """Begin a new episode with its first ``observation`` [...] and ``state``."""
        while hasattr(state, "env"):
            state = state.env
        self._seen = [np.ravel(observation)]
        self._true = [
            np.zeros(0) if self._scene is None or state is None else self._scene.first(state)
        ]
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
            self._figure = _Figure(self._scene is not None)
        figure = self._figure
        figure.clear()
        if self._scene is not None:
            self._scene.draw(figure.plant, self._true, self._actions)
        first = max(0, len(self._rewards) - _SHOWN)
        times = np.arange(first, len(self._rewards) + 1)
        _signals(figure.seen, "seen", times, self._seen[first:])
        _signals(figure.done, "action", times[1:], self._actions[first:])
        rewards = [np.array([reward]) for reward in self._rewards[first:]]
        _signals(figure.earned, "reward", times[1:], rewards)
        figure.earned.set_xlabel("step", fontsize=7)
        return figure.pixels()


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
