"""Figures of a study: learning curves and final returns, each as PNG and SVG.

This module uses matplotlib's object API without pyplot, so it needs no display and does not change
the caller's current figure. Equal data give equal SVG bytes.
"""

import io
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator

from rtd3jax.evaluation.style import STYLE
from rtd3jax.study.colours import colour_of, ordered
from rtd3jax.study.results import is_trained, reference_names
from rtd3jax.study.statistics import iqm_bands, reference_mean, seed_means, summarise, thinned
from rtd3jax.system.files import write_bytes_atomically

REFERENCE_COLOUR = "#777777"
BOUNDS = ("ceiling", "upper bound")
REFERENCE_DASHES: dict[str, Any] = {
    "random": (0, (2, 2)),
    "constant": (0, (7, 3)),
    "ceiling": "solid",
    "upper bound": (0, (1, 1)),
}
OTHER_DASHES = ((0, (7, 3, 2, 3)), (0, (4, 2)), (0, (7, 2, 2, 2, 2, 2)))
"""Line styles of baselines; a baseline has the same style in every figure."""
MARKERS = "osD^vPX"

# Fraction of the lower edges of the bands that may lie below a panel of learning curves.
CLIPPED_SHARE = 0.25

_STYLE: Any = {
    **STYLE,
    "svg.hashsalt": "rtd3jax",  # otherwise element ids are random
    "axes.titlesize": 9.5,
}


Ceilings = Mapping[tuple[str, str], Mapping[str, Any]]
"""``mean``, ``kind`` and ``measure`` by (env, disturbance); see `rtd3jax.study.ceilings`."""


def learning_curves(
    curves: pd.DataFrame,
    references: pd.DataFrame | None,
    directory: str | Path,
    ceilings: Ceilings | None = None,
) -> list[Path]:
    """Draw return against environment steps; return the paths of the PNG and the SVG.

    ``curves`` has the columns of `rtd3jax.study.results.CURVES`, and ``references`` those of
    `rtd3jax.study.results.EPISODES`, of which only the rows of reference policies are used. Known
    ``ceilings`` are drawn too. There is a panel for each disturbance (row) and history length
    (column). A line is the interquartile mean (IQM) over the seeds with a finite value at this
    step, and its band is the 95% bootstrap interval.

    The panels of a row share their y-limits: from the lower quartile of all lower band edges
    (or the lowest final IQM, if lower, so that no line ends outside) to the highest upper edge. So
    very low returns early in training are outside the panel, and do not compress the other curves.
    """
    with mpl.rc_context(_STYLE):
        tasks = _tasks(curves)
        # Agents without a window (length 0) are shown in the panels of all lengths.
        lengths = sorted({int(length) for length in curves["history_length"]} - {0})
        figure, grid = _panels(len(tasks), max(len(lengths), 1), width=3.6, height=2.7)
        if not tasks:
            _note_empty(grid[0, 0], "no learning curves")
        means = {task: _reference_means(references, ceilings, task) for task in tasks}
        for row, task in zip(grid, tasks, strict=False):
            _curve_row(row, curves, means[task], task, lengths, _title(tasks, task))
        for axes in grid[-1]:
            axes.set_xlabel("environment steps")
        for axes in grid[:, 0]:
            axes.set_ylabel("return")
        handles = [
            Line2D([], [], color=colour_of(name), linewidth=1.8, label=name)
            for name in ordered(curves["algorithm"])
        ]
        _legend(figure, handles + _reference_handles(means.values()))
        return _save(figure, directory, "learning_curves")


def final_returns(
    episodes: pd.DataFrame, directory: str | Path, ceilings: Ceilings | None = None
) -> list[Path]:
    """Draw the final evaluation; return the paths of the PNG and the SVG.

    ``episodes`` has the columns of `rtd3jax.study.results.EPISODES`. There is a panel for each
    disturbance, with the algorithms along x. Light dots are the mean returns of single seeds, the
    marker is their interquartile mean, and the bar is its 95 % bootstrap interval (none for a
    single seed). The shape of the marker shows the history length; horizontal lines are the
    reference policies and known ``ceilings``.
    """
    with mpl.rc_context(_STYLE):
        lanes = seed_means(episodes)
        trained = lanes[is_trained(lanes)]
        tasks = _tasks(lanes)
        algorithms = ordered(trained["algorithm"])
        lengths = sorted({int(length) for length in trained["history_length"]})
        rows, columns = math.ceil(max(len(tasks), 1) / 2), min(max(len(tasks), 1), 2)
        width = max(3.8, 0.9 + len(algorithms) * (0.45 + 0.1 * len(lengths)))
        figure, grid = _panels(rows, columns, width=width, height=3.4)
        panels = list(grid.flat)
        if not tasks:
            _note_empty(panels[0], "no final evaluation")
        means = {task: _reference_means(episodes, ceilings, task) for task in tasks}
        for axes, task in zip(panels, tasks, strict=False):
            _final_panel(axes, _of_task(trained, task), algorithms, lengths)
            _fit(axes, _of_task(trained, task)["return"], means[task])
            axes.set_title(_title(tasks, task))
        for axes in panels[max(len(tasks), 1) :]:
            axes.remove()
        for axes in grid[:, 0]:
            axes.set_ylabel("return of the final policy")
        handles = [
            Line2D([], [], color="#555555", marker=marker, linestyle="", label=_window(length))
            for length, marker in zip(lengths, _markers(lengths), strict=True)
        ]
        _legend(figure, handles + _reference_handles(means.values()))
        return _save(figure, directory, "final_returns")


def _curve_row(
    row: Iterable[Axes],
    curves: pd.DataFrame,
    means: dict[str, float],
    task: tuple[str, str],
    lengths: list[int],
    title: str,
) -> None:
    """Draw the panels of one task, one per history length, with common y-limits."""
    of_task = _of_task(curves, task)
    row = list(row)
    lower, upper, final = [], [], []
    columns: list[int | None] = list(lengths) or [None]
    for axes, length in zip(row, columns, strict=True):
        axes.set_title(title if length is None else f"{title}, {_window(length)}")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        for name in ordered(of_task["algorithm"]):
            line = of_task[of_task["algorithm"] == name]
            line = line[line["history_length"].isin([0, length])]
            steps, iqm, low, high = _band(line)
            if steps.size == 0:
                continue
            colour = colour_of(name)
            axes.plot(steps, iqm, color=colour, linewidth=1.6, label=name, zorder=3)
            axes.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0)
            lower.append(low)
            upper.append(high)
            final.append(iqm[-1])
    edges = np.array([])
    if lower:
        bottom = min(np.quantile(np.concatenate(lower), CLIPPED_SHARE), min(final))
        edges = np.array([bottom, np.concatenate(upper).max()])
    for axes in row:
        _fit(axes, edges, means)


def _band(line: pd.DataFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Steps, IQM over seeds, and the bounds of its interval, [evaluations] each.

    Steps without values are left out, and so are most of very many steps (`thinned`). For a single
    seed, the bounds equal its value.
    """
    table = thinned(line.pivot(index="seed", columns="step", values="return"))
    count, iqm, low, high = iqm_bands(table.to_numpy(np.float64))
    steps, seen = table.columns.to_numpy(), count > 0
    low, high = (np.where(count > 1, bound, iqm) for bound in (low, high))
    return steps[seen], iqm[seen], low[seen], high[seen]


def _final_panel(
    axes: Axes, lanes: pd.DataFrame, algorithms: list[str], lengths: list[int]
) -> None:
    """Draw seeds, IQM and interval of each (algorithm, history length) of one task."""
    markers = dict(zip(lengths, _markers(lengths), strict=True))
    for position, name in enumerate(algorithms):
        of_algorithm = lanes[lanes["algorithm"] == name]
        present = sorted({int(length) for length in of_algorithm["history_length"]})
        # Evenly spaced around the tick over the lengths of this algorithm, so td3 is centred.
        gap = 0.7 / max(len(lengths), 3)
        for index, length in enumerate(present):
            values = of_algorithm.loc[of_algorithm["history_length"] == length, "return"]
            summary = summarise(values)
            if summary.n == 0:
                continue
            x = position + gap * (index - (len(present) - 1) / 2)
            finite = values[np.isfinite(values)]
            # Next to the marker: under it, the bar would hide the dots.
            axes.scatter(
                np.full(len(finite), x - 0.32 * gap),
                finite,
                s=9,
                color=colour_of(name),
                alpha=0.35,
                linewidths=0,
                zorder=2,
            )
            if summary.n >= 2:
                bounds = [summary.iqm_low, summary.iqm_high]
                axes.plot([x, x], bounds, color=colour_of(name), linewidth=1.6, zorder=3)
            axes.plot(
                x,
                summary.iqm,
                marker=markers[length],
                markersize=6,
                color=colour_of(name),
                markeredgecolor="white",
                markeredgewidth=0.7,
                linestyle="",
                label=f"{name} {length}",
                zorder=4,
            )
    axes.set_xticks(
        range(len(algorithms)), algorithms, rotation=28, ha="right", rotation_mode="anchor"
    )
    axes.set_xlim(-0.6, max(len(algorithms), 1) - 0.4)
    axes.grid(False, axis="x")


def _fit(axes: Axes, values: Iterable[float], references: dict[str, float]) -> None:
    """Set y-limits around ``values`` and draw the reference lines.

    A reference whose distance exceeds the range of the values is named at the edge instead, because
    its line would compress all values.
    """
    values = np.asarray(list(values), dtype=np.float64)
    values = values[np.isfinite(values)]
    if values.size == 0:
        values = np.array(list(references.values()) or [0.0])
    low, high = float(values.min()), float(values.max())
    span = (high - low) or max(abs(high), 1.0) * 0.1
    near = [mean for mean in references.values() if low - span <= mean <= high + span]
    low, high = min([low, *near]), max([high, *near])
    margin = 0.06 * ((high - low) or span)
    far: dict[str, list[str]] = {"top": [], "bottom": []}
    for name, mean in references.items():
        if mean in near:
            axes.axhline(
                mean,
                color=REFERENCE_COLOUR,
                linestyle=_dashes(name),
                linewidth=1.2,
                label=name,
                zorder=2.5,
            )
        else:
            arrow, edge = ("↑", "top") if mean > high else ("↓", "bottom")
            far[edge].append(f"{arrow} {name}: {mean:.4g}")
    for edge, texts in far.items():
        if texts:
            # Free space for the text, so that no curve crosses it.
            room = 0.12 * (high - low + 2 * margin)
            low, high = (low - room, high) if edge == "bottom" else (low, high + room)
            axes.text(
                0.98,
                0.02 if edge == "bottom" else 0.98,
                "   ".join(texts),
                transform=axes.transAxes,
                ha="right",
                va=edge,
                fontsize=7.5,
                color="#555555",
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
                zorder=5,
            )
    axes.set_ylim(low - margin, high + margin)


def _reference_means(
    episodes: pd.DataFrame | None, ceilings: Ceilings | None, task: tuple[str, str]
) -> dict[str, float]:
    """The finite mean returns of the reference policies, and the ceiling of the return."""
    means = {}
    if episodes is not None:
        rows = _of_task(episodes, task)
        rows = rows[~is_trained(rows)]
        for name in reference_names(rows):
            mean = reference_mean(rows.loc[rows["algorithm"] == name, "return"])
            if math.isfinite(mean):
                means[name] = mean
    best = (ceilings or {}).get(task, {})
    if best.get("mean") is not None and best["measure"] == "return":
        means["ceiling" if best["kind"] == "exact" else "upper bound"] = best["mean"]
    return means


def _reference_handles(means: Iterable[dict[str, float]]) -> list[Line2D]:
    """Legend entries of the references in all panels."""
    present = {name for of_task in means for name in of_task}
    return [
        Line2D(
            [],
            [],
            color=REFERENCE_COLOUR,
            linestyle=_dashes(name),
            linewidth=1.2,
            label=name if name in BOUNDS else f"{name} policy",
        )
        for name in sorted(present, key=lambda name: (name in BOUNDS, name != "random", name))
    ]


def _dashes(name: str) -> Any:
    """The line style of a reference or a ceiling."""
    other = OTHER_DASHES[sum(name.encode()) % len(OTHER_DASHES)]
    return REFERENCE_DASHES.get(name, other)


def _panels(rows: int, columns: int, width: float, height: float) -> tuple[Figure, np.ndarray]:
    """A figure with [rows, columns] panels of ``width`` by ``height`` inches each."""
    rows = max(rows, 1)
    # With a minimum width, a single panel has space for its legend.
    figure = Figure(figsize=(max(width * columns, 5.2), height * rows + 0.7), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _legend(figure: Figure, handles: list[Line2D]) -> None:
    """Draw a legend below all panels, where it covers no data."""
    if handles:
        # About 1.6 inches per entry.
        columns = max(1, min(len(handles), int(figure.get_figwidth() / 1.6)))
        figure.legend(handles=handles, loc="outside lower center", ncols=columns)


def _note_empty(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center")


def _save(figure: Figure, directory: str | Path, stem: str) -> list[Path]:
    paths = []
    for suffix, options in (
        ("png", {"dpi": 160}),
        ("svg", {"metadata": {"Date": None, "Creator": None}}),
    ):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix, **options)
        path = Path(directory) / f"{stem}.{suffix}"
        write_bytes_atomically(path, buffer.getvalue())
        paths.append(path)
    return paths


def _tasks(table: pd.DataFrame) -> list[tuple[str, str]]:
    """The sorted (env, disturbance) pairs of ``table``; those without a disturbance come first."""
    pairs = set(zip(table["env"], table["disturbance"], strict=True))
    return sorted(pairs, key=lambda pair: (pair[0], pair[1] != "none", pair[1]))


def _of_task(table: pd.DataFrame, task: tuple[str, str]) -> pd.DataFrame:
    return table[(table["env"] == task[0]) & (table["disturbance"] == task[1])]


def _title(tasks: list[tuple[str, str]], task: tuple[str, str]) -> str:
    """The disturbance, with its environment if the study has several environments."""
    name = "no disturbance" if task[1] == "none" else task[1]
    return name if len({env for env, _ in tasks}) == 1 else f"{task[0]}: {name}"


def _markers(lengths: list[int]) -> list[str]:
    return [MARKERS[index % len(MARKERS)] for index in range(len(lengths))]


def _window(length: int) -> str:
    return f"history {length}"
