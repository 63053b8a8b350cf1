"""Plots an episode: true and seen observations, actions, rewards, and the hidden variable."""

from typing import TYPE_CHECKING, Any

import numpy as np

from rtd3jax.errors import UserError
from rtd3jax.evaluation.rollout import Trajectory
from rtd3jax.evaluation.style import BLACK, GREY, PALETTE, STYLE
from rtd3jax.system.numbers import is_whole

if TYPE_CHECKING:  # importing matplotlib takes two seconds
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_PANELS = 6
"""Largest number of elements that get a panel each; more elements share one panel."""

_TRUE, _SEEN, _OTHER = BLACK, PALETTE[1], PALETTE[0]
_COLOURS = (*PALETTE, BLACK, GREY)
"""Colours of the lines in a panel."""

_STYLE: Any = {**STYLE, "legend.fontsize": 8.0}


def plot_episode(trajectory: Trajectory, episode: int = 0) -> "Figure":
    """Draw one episode of `rtd3jax.rollout`: a panel for each signal, over time.

    The figure is a matplotlib figure: ``figure.savefig("episode.png")`` saves it, and a notebook
    shows it.

    Args:
        trajectory: the result of `rtd3jax.rollout`.
        episode: index of the episode.

    Raises:
        UserError: for another type of ``trajectory``, or an index that it does not have.
    """
    if not isinstance(trajectory, Trajectory):
        raise UserError(
            f"plot_episode needs the result of rtd.rollout, not {type(trajectory).__name__}"
        )
    count = len(trajectory.lengths)
    if not is_whole(episode) or not 0 <= episode < count:
        raise UserError(f"episode must be an integer from 0 to {count - 1}, not {episode!r}")
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE):
        panels = _panels(trajectory)
        figure = Figure(figsize=(7.2, 0.9 + 1.3 * len(panels)), dpi=120, layout="constrained")
        axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for axis, (kind, elements) in zip(axes, panels, strict=True):
            _draw(axis, kind, elements, trajectory, int(episode))
            if axis.get_legend_handles_labels()[1]:
                # Next to the panel, where it cannot hide a line.
                axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.05))
        known = trajectory.step_seconds is not None
        axes[-1].set_xlabel("time in s" if known else "step")
        times = _times(trajectory, int(trajectory.lengths[episode]) + 1)
        axes[-1].set_xlim(times[0], times[-1])
        figure.align_ylabels(axes)
        which = f"episode {episode} of " if count > 1 else ""
        figure.suptitle(
            f"{trajectory.environment}, {which}seed {trajectory.seed}: "
            f"return {trajectory.returns[episode]:.5g} in {trajectory.lengths[episode]} steps",
            fontsize=10,
        )
    return figure


def _panels(trajectory: Trajectory) -> list[tuple[str, list[int]]]:
    """The panels from top to bottom: for each, a kind and the elements of this kind."""
    panels: list[tuple[str, list[int]]] = []
    for kind, names in (
        ("observation", trajectory.observation_names),
        ("action", trajectory.action_names),
    ):
        every = list(range(len(names)))
        panels += [(kind, [k]) for k in every] if len(names) <= MOST_PANELS else [(kind, every)]
    if trajectory.hidden is not None:
        panels.append(("hidden", list(range(len(trajectory.hidden_names)))))
    return [*panels, ("reward", [0])]


def _draw(
    axis: "Axes", kind: str, elements: list[int], trajectory: Trajectory, episode: int
) -> None:
    length = int(trajectory.lengths[episode])
    times = _times(trajectory, length + 1)
    if kind == "observation":
        _draw_observation(axis, elements, trajectory, episode, times)
        return
    if kind == "hidden":
        assert trajectory.hidden is not None
        values, names = trajectory.hidden[episode], trajectory.hidden_names
        axis.set_ylabel("hidden")
    elif kind == "reward":
        values, names = trajectory.rewards[episode][:, None], ("reward",)
        axis.set_ylabel("reward")
    else:
        values, names = trajectory.actions[episode], trajectory.action_names
        axis.set_ylabel(names[elements[0]] if len(elements) == 1 else "action")
        if len(elements) == 1:
            _draw_bounds(axis, values[:length, elements[0]], trajectory, elements[0])
    single = len(elements) == 1
    for place, k in enumerate(elements):
        axis.step(
            times,
            # An action is constant during its step; this includes the last action.
            np.append(values[:length, k], values[length - 1, k]),
            where="post",
            color=_OTHER if single else _COLOURS[place % len(_COLOURS)],
            linewidth=1.2,
            label=names[k] if not single or kind == "hidden" else None,
        )


def _draw_observation(
    axis: "Axes", elements: list[int], trajectory: Trajectory, episode: int, times: np.ndarray
) -> None:
    true = trajectory.true[episode, : times.size]
    seen = trajectory.seen[episode, : times.size]
    names = trajectory.observation_names
    if len(elements) > 1:
        axis.set_ylabel("observation")
        for place, k in enumerate(elements):
            colour = _COLOURS[place % len(_COLOURS)]
            # There is only space for two columns of eight names.
            label = names[k] if place < len(_COLOURS) else None
            axis.plot(times, true[:, k], color=colour, linewidth=1.0, label=label)
        return
    k = elements[0]
    axis.set_ylabel(names[k])
    if names[k] in trajectory.seen_names:
        shown = seen[:, trajectory.seen_names.index(names[k])]
        differs = not np.array_equal(shown, true[:, k], equal_nan=True)
        if differs:
            axis.plot(times, shown, ".", color=_SEEN, markersize=3.0, label="seen", zorder=2)
        label = "true" if differs else None
        axis.plot(times, true[:, k], color=_TRUE, linewidth=1.2, label=label, zorder=3)
    else:
        axis.plot(times, true[:, k], color=_TRUE, linewidth=1.2, linestyle="--", label="not seen")


def _draw_bounds(axis: "Axes", values: np.ndarray, trajectory: Trajectory, k: int) -> None:
    """Draw a bound if the action comes near it; otherwise it would compress the curve."""
    low, high = float(trajectory.action_low[k]), float(trajectory.action_high[k])
    for bound, near in ((low, values.min() - low), (high, high - values.max())):
        if near < 0.05 * (high - low):
            axis.axhline(bound, color=GREY, linewidth=0.8, linestyle=(0, (4, 2)))


def _times(trajectory: Trajectory, rows: int) -> np.ndarray:
    return np.arange(rows) * (trajectory.step_seconds or 1.0)
