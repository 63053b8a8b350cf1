"""Plots a table of robustness: a panel per stress, with a line per policy."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from rtd3jax.errors import UserError
from rtd3jax.evaluation.style import GREY, PALETTE, STYLE
from rtd3jax.registries import AGENTS

if TYPE_CHECKING:  # importing matplotlib takes two seconds
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLUMNS = ("policy", "stress", "quantity", "value", "return", "standard_error")
_OTHERS = (*reversed(PALETTE), GREY)
"""Colours of policies that are not agents."""
_DASHES: tuple[Any, ...] = ("solid", (0, (5, 2)), (0, (1, 1)), (0, (5, 2, 1, 2)))
"""Line styles of policies of the same agent."""
_MOST_COLUMNS = 4


def plot_robustness(table: "pd.DataFrame", *, title: str = "") -> "Figure":
    """Draw a table of `rtd3jax.robustness`: mean returns, with a band of two standard errors.

    A policy whose name begins with the name of an agent, as "h-td3, history 10", has the colour of
    this agent. The figure is a matplotlib figure, as that of `rtd3jax.plot_episode`.

    Args:
        table: the result of `rtd3jax.robustness`, or rows of it.
        title: the figure's title.

    Raises:
        UserError: for a table without rows or without the columns of `rtd3jax.robustness`.
    """
    missing = [name for name in _COLUMNS if name not in getattr(table, "columns", ())]
    if missing or not len(table):
        lacks = f"lacks {', '.join(missing)}" if missing else "has no rows"
        raise UserError(f"plot_robustness needs a table of rtd.robustness; this one {lacks}")
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        stresses = list(dict.fromkeys(table["stress"]))
        rows = math.ceil(len(stresses) / _MOST_COLUMNS)
        columns = math.ceil(len(stresses) / rows)
        size = (max(2.6 * columns, 4.2), 2.2 * rows + 0.7)
        figure = Figure(figsize=size, dpi=120, layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False)
        styles = _styles(list(dict.fromkeys(table["policy"])))
        for axes, stress in zip(grid.flat, stresses, strict=False):
            _draw(axes, table[table["stress"] == stress], styles)
        for axes in list(grid.flat)[len(stresses) :]:
            axes.remove()
        for axes in grid[:, 0]:
            axes.set_ylabel("mean return")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), columns))
        if title:
            figure.suptitle(title, fontsize=10)
    return figure


def _draw(axes: "Axes", rows: "pd.DataFrame", styles: dict[str, dict[str, Any]]) -> None:
    from matplotlib.ticker import MaxNLocator

    for name, style in styles.items():
        own = rows[rows["policy"] == name].sort_values("value")
        values = own["value"].to_numpy(np.float64)
        mean = own["return"].to_numpy(np.float64)
        error = 2.0 * own["standard_error"].to_numpy(np.float64)
        # A policy that lacks this stress is still in the legend.
        axes.plot(values, mean, marker="o", markersize=2.5, linewidth=1.4, label=name, **style)
        axes.fill_between(
            values, mean - error, mean + error, color=style["color"], alpha=0.15, linewidth=0
        )
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    axes.set_xlabel(str(rows["quantity"].iloc[0]))


def _styles(policies: list[str]) -> dict[str, dict[str, Any]]:
    """Colour and line style of each policy; up to four policies of one colour differ in style."""
    found: dict[str, dict[str, Any]] = {}
    used: dict[str, int] = {}
    agents = {name: _agent_of(name) for name in policies}
    taken = {colour for agent in agents.values() if (colour := _colour_of(agent))}
    others = [colour for colour in _OTHERS if colour not in taken] or list(_OTHERS)
    for name in policies:
        colour = _colour_of(agents[name])
        if colour is None:
            count = sum(style["color"] in others for style in found.values())
            colour = others[count % len(others)]
        used[colour] = used.get(colour, -1) + 1
        found[name] = {"color": colour, "linestyle": _DASHES[used[colour] % len(_DASHES)]}
    return found


def _agent_of(policy: str) -> str | None:
    """The agent that the name of a policy begins with; the longest, if there are several."""
    begins = [
        name for name in AGENTS if policy == name or policy.startswith((f"{name},", f"{name} "))
    ]
    return max(begins, key=len, default=None)


def _colour_of(agent: str | None) -> str | None:
    return None if agent is None else AGENTS[agent].colour
