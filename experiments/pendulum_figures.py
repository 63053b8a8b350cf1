"""Draws the paper's figures of the pendulum from the tables of results.

Usage: python experiments/pendulum_figures.py [--results DIR] [--out DIR]

The script reads pendulum.parquet, pendulum_curves.parquet and generalisation.parquet. It writes the
following figures as PNG and SVG, if the tables have rows for them:

* pendulum_learning_curves: rows are disturbances, columns are agents, a curve per length;
* pendulum: final return for each agent, a line per length; dots are seeds; the dashed line is a
  Bayes filter that knows the process;
* action_history: `lstm-td3` with and without past actions, a panel per length;
* generalisation: bars of the agents trained on `random-sine`, a panel per condition.

A solid grey line is the fully observed optimum, and a dotted one uniform random actions. Only rows
with the current settings are drawn. Bands and bars are one standard deviation over seeds.
"""

import argparse
import pathlib
import sys

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import rtd3jax as rtd
from rtd3jax.study import presets
from rtd3jax.study.colours import colour_of

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from pendulum_cells import current_setting, in_the_paper  # noqa: E402
from writing import RESULTS  # noqa: E402

DISTURBANCES = (*presets.PENDULUM_DISTURBANCES, *presets.ACTION_HISTORY_DISTURBANCES)
GREY = "#777777"
NORMALISED = "normalised return\n(1: the fully observed optimum,\n0: uniform random actions)"
LINES = {0: "#000000", 1: "#56B4E9", 3: "#009E73", 6: "#E69F00", 10: "#D55E00", 20: "#CC79A7"}
"""A colour for each history length; 0 is for agents without a window."""


def current(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows that were trained with the current settings."""
    if rows.empty or "setting" not in rows:
        return rows.iloc[:0]
    return rows[rows["setting"] == rows["algorithm"].map(current_setting)]


def save(figure: Figure, out: pathlib.Path, name: str) -> None:
    """Save as PNG and SVG; equal data give equal SVG files."""
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / f"{name}.png", dpi=150)
    with matplotlib.rc_context({"svg.hashsalt": name}):
        figure.savefig(out / f"{name}.svg", metadata={"Date": None})


def agents_in(rows: pd.DataFrame) -> list[str]:
    """The agents of a table, in the paper's order."""
    return [agent for agent in rtd.ALGORITHMS if (rows["algorithm"] == agent).any()]


def lengths_in(rows: pd.DataFrame) -> list[int]:
    """The history lengths of a table, the shortest first."""
    return sorted(int(length) for length in rows["history_length"].unique())


def name_of(length: int) -> str:
    """A history length in a legend."""
    return f"l = {length}" if length else "no window"


def filter_returns(results: pathlib.Path) -> dict[str, float]:
    """Normalised returns of a Bayes filter that knows the process, by disturbance.

    They come from experiments/filter_reference.py, and are a lower bound of the optimal return.
    """
    path = results / "filter_reference.parquet"
    if not path.exists():
        return {}
    return dict(pd.read_parquet(path).set_index("disturbance")["normalised"])


def learning_curves(curves: pd.DataFrame) -> Figure:
    """Draw the mean normalised return over seeds, with a band of one standard deviation."""
    names = [name for name in DISTURBANCES if (curves["disturbance"] == name).any()]
    agents = agents_in(curves)
    figure = Figure(figsize=(2.1 * len(agents) + 1, 1.7 * len(names) + 0.6), layout="constrained")
    panels = figure.subplots(len(names), len(agents), sharex=True, sharey=True, squeeze=False)
    shown: dict[int, object] = {}
    for number, (row, name) in enumerate(zip(panels, names, strict=True)):
        for axes, agent in zip(row, agents, strict=True):
            own = curves[(curves["disturbance"] == name) & (curves["algorithm"] == agent)]
            for length in lengths_in(own):
                of_length = own[own["history_length"] == length]
                steps = of_length.groupby("step")["normalised"].agg(["mean", "std"]).fillna(0.0)
                x = steps.index.to_numpy() / 1_000
                (line,) = axes.plot(x, steps["mean"], color=LINES.get(length, GREY), lw=1.2)
                low, high = steps["mean"] - steps["std"], steps["mean"] + steps["std"]
                axes.fill_between(x, low, high, color=LINES.get(length, GREY), alpha=0.15, lw=0)
                shown[length] = line
            _draw_scale(axes)
            axes.set_ylim(-0.5, 1.05)
            axes.grid(color="#E4E4E4", lw=0.6)
            middle = {"ha": "center", "transform": axes.transAxes}
            if own.empty:
                text = "not run" if in_the_paper(name, agent) else "not in the paper"
                axes.text(0.5, 0.5, text, va="center", **middle)
            else:
                kept = own.groupby("history_length")["seed"].nunique()
                alone = ", ".join(f"l = {length}" for length in kept.index[kept.eq(1)])
                note = f"{alone}: one seed's curve was kept" if alone else ""
                axes.text(0.5, 0.04, note, va="bottom", fontsize="x-small", **middle)
            if number == 0:
                axes.set_title(agent, fontsize=9)
        row[0].set_ylabel(name, fontsize=9)
    figure.supxlabel("thousand steps", fontsize=9)
    figure.supylabel(NORMALISED, fontsize=9)
    _legend_of_lengths(figure, shown)
    return figure


def final_returns(lanes: pd.DataFrame, filtered: dict[str, float]) -> Figure:
    """Draw a panel per disturbance: agents along x, a line per length; dots are seeds.

    The dashed line is the return of the filter.
    """
    names = [name for name in DISTURBANCES if (lanes["disturbance"] == name).any()]
    columns = min(len(names), 4)
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(2.6 * columns + 1.8, 3.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes in panels.flat[len(names) :]:
        axes.axis("off")
    shown: dict[int, object] = {}
    for axes, name in zip(panels.flat, names, strict=False):
        here = lanes[lanes["disturbance"] == name]
        agents = agents_in(here)
        for length in lengths_in(here):
            own = here[here["history_length"] == length]
            means = own.groupby("algorithm")["normalised"].mean()
            x = [index for index, agent in enumerate(agents) if agent in means]
            y = [means[agent] for agent in agents if agent in means]
            colour = LINES.get(length, GREY)
            (shown[length],) = axes.plot(x, y, "o-", color=colour, lw=1.2, ms=4)
            for index, agent in enumerate(agents):
                seeds = own[own["algorithm"] == agent]["normalised"]
                axes.plot([index] * len(seeds), seeds, ".", ms=3, color=colour, alpha=0.4)
        _draw_scale(axes)
        if name in filtered:
            axes.axhline(filtered[name], color=GREY, lw=1.0, ls="--")
        axes.set_xticks(range(len(agents)), agents, rotation=60, ha="right")
        axes.set_title(name, fontsize=10)
        axes.grid(axis="y", color="#E4E4E4", lw=0.6)
    figure.supylabel(NORMALISED, fontsize=9)
    _legend_of_lengths(figure, shown)
    return figure


def action_history(lanes: pd.DataFrame) -> Figure | None:
    """Draw `lstm-td3` with and without past actions, with a panel per length."""
    pair = ("lstm-td3", "lstm-td3-no-action")
    own = lanes[lanes["algorithm"].isin(pair)]
    lengths = lengths_in(own)
    names = [name for name in DISTURBANCES if (own["disturbance"] == name).any()]
    if not lengths:
        return None
    figure = Figure(figsize=(2.6 * len(lengths) + 1, 3.6), layout="constrained")
    panels = figure.subplots(1, len(lengths), sharey=True, squeeze=False)[0]
    for axes, length in zip(panels, lengths, strict=True):
        here = own[own["history_length"] == length]
        _bars(axes, here, "disturbance", names, list(pair))
        axes.set_title(f"l = {length}", fontsize=10)
    figure.supylabel(NORMALISED, fontsize=9)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, ncols=2, loc="outside upper center")
    return figure


def generalisation(moved: pd.DataFrame) -> Figure | None:
    """Draw agents trained on `random-sine` under each condition, with a panel per length."""
    lengths = [length for length in lengths_in(moved) if length]
    if not lengths:
        return None
    conditions = list(dict.fromkeys(moved["tested_on"]))
    figure = Figure(figsize=(7.0, 2.6 * len(lengths) + 0.9), layout="constrained")
    panels = figure.subplots(len(lengths), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, length in zip(panels, lengths, strict=True):
        here = moved[moved["history_length"].isin([0, length])]
        _bars(axes, here, "tested_on", conditions, agents_in(moved))
        axes.set_ylabel(f"l = {length}", fontsize=9)
    figure.supylabel(NORMALISED, fontsize=9)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=7, ncols=3, loc="outside upper center")
    return figure


def _draw_scale(axes: Axes) -> None:
    """Draw the optimum as a solid line, and uniform random actions as a dotted one."""
    axes.axhline(1.0, color=GREY, lw=0.8)
    axes.axhline(0.0, color=GREY, lw=0.8, ls=":")


def _legend_of_lengths(figure: Figure, shown: dict[int, object]) -> None:
    """Draw a legend of the lengths in ``shown``, next to the panels."""
    order = sorted(shown)
    figure.legend(
        [shown[length] for length in order],
        [name_of(length) for length in order],
        loc="outside right upper",
        fontsize=8,
    )


def _bars(
    axes: object, rows: pd.DataFrame, column: str, names: list[str], agents: list[str]
) -> None:
    """Draw a group of bars, one for each agent, for each of ``names``."""
    width = 0.8 / len(agents)
    for k, agent in enumerate(agents):
        found = rows[rows["algorithm"] == agent].groupby(column)["normalised"]
        means, spread = found.mean(), found.std().fillna(0.0)
        x = [index + width * (k + 0.5) - 0.4 for index, name in enumerate(names) if name in means]
        y = np.array([means[name] for name in names if name in means])
        error = np.array([spread[name] for name in names if name in means])
        axes.bar(x, y, width, yerr=error, color=colour_of(agent), label=agent, error_kw={"lw": 0.8})
    _draw_scale(axes)
    axes.set_ylim(min(0.0, axes.get_ylim()[0]), 1.08)
    labels = [name.split(":")[0] + (" σ = 1" if "sigma=1" in name else "") for name in names]
    axes.set_xticks(range(len(names)), labels, rotation=30, ha="right", fontsize=8)
    axes.set_xlim(-0.6, len(names) - 0.4)  # also without bars of the last name
    axes.set_axisbelow(True)
    axes.grid(axis="y", color="#E4E4E4", lw=0.6)


def draw_all(results: pathlib.Path, out: pathlib.Path) -> None:
    """Draw every figure for which the tables in ``results`` have rows."""

    def rows(name: str) -> pd.DataFrame:
        path = results / f"{name}.parquet"
        return current(pd.read_parquet(path)) if path.exists() else pd.DataFrame()

    lanes, curves, moved = rows("pendulum"), rows("pendulum_curves"), rows("generalisation")
    drawn = {
        "pendulum": final_returns(lanes, filter_returns(results)) if len(lanes) else None,
        "pendulum_learning_curves": learning_curves(curves) if len(curves) else None,
        "action_history": action_history(lanes) if len(lanes) else None,
        "generalisation": generalisation(moved) if len(moved) else None,
    }
    for name, figure in drawn.items():
        if figure is None:
            print(f"missing: {name}: no rows of the current setting")
        else:
            save(figure, out, name)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=pathlib.Path, default=RESULTS)
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parser.parse_args(arguments)
    draw_all(options.results, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
