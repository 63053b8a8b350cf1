"""The tables and the picture of experiments/rover_soil.py, from its rows.

Intervals are 95% t intervals over seeds; verdicts are those of experiments/effects.py. The margin
of equivalence on a ground is 2% of the distance between the returns of the constant command and of
the best controller there. A return is minus the sum of squared errors of a drive. The picture shows
returns with the sign changed, on a logarithmic axis: a lower point is a better policy.
"""

import functools
import pathlib
import sys

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import rtd3jax as rtd

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from claims import BEST  # noqa: E402
from effects import MARGIN, Effect, combine, mean_interval  # noqa: E402
from rover import pick  # noqa: E402
from writing import markdown_table, seeds_text  # noqa: E402

SLIPS = ("ar1-slip", "sine-slip")
GROUNDS = ("mixed", "mixed-slope", "dry-sand")
SOIL = "mixed"
"""The ground on which agents are trained; they are tested on all grounds."""
UNTRAINED = "no training"
"""The entry of ``trained_on`` in the rows of controllers."""
TRANSFER_SLIP = "sine-slip"
"""The slip on which the agents of the paper's claim 14 are trained."""
COLOURS = {"ar1-slip": "#56B4E9", "sine-slip": "#E69F00", SOIL: "#009E73"}
CONTROLLER_LINES = {"feed-forward and PI": "-", "adaptive slip estimate": "--"}


def means_of(rows: pd.DataFrame, algorithm: str, trained_on: str, tested_on: str) -> np.ndarray:
    """Mean return of each seed."""
    return pick(rows, algorithm, trained_on, tested_on)["mean"].to_numpy()


def text_of(values: np.ndarray, seeds: int) -> str:
    """Mean over seeds with its interval."""
    if not len(values):
        return "not trained yet"
    count = seeds_text(len(values), seeds)
    if len(values) == 1:
        return f"{values[0]:.3f}{count}"
    mean, low, high = mean_interval(values)
    return f"{mean:.3f} [{low:.3f}, {high:.3f}]{count}"


def margin_on(rows: pd.DataFrame, ground: str) -> float:
    """The margin of equivalence on a ground, in units of the return."""
    found = {name: means_of(rows, name, UNTRAINED, ground).mean() for name in untrained(rows)}
    return MARGIN * float(max(found.values()) - found["constant command"])


def untrained(rows: pd.DataFrame) -> list[str]:
    """The controllers that need no training, in the order of the table."""
    return list(dict.fromkeys(rows[rows["trained_on"] == UNTRAINED]["algorithm"]))


def returns_on(rows: pd.DataFrame, ground: str, seeds: int) -> str:
    """The return of every agent and controller on a ground."""

    def entry(name: str, source: str) -> str:
        return text_of(means_of(rows, name, source, ground), seeds)

    header = ["agent", *(f"trained on {source}" for source in COLOURS), "no training"]
    body = [[a, *(entry(a, source) for source in COLOURS), ""] for a in rtd.ALGORITHMS]
    blank = [""] * len(COLOURS)
    body += [[f"*{name}*", *blank, entry(name, UNTRAINED)] for name in untrained(rows)]
    return f"Tested on `{ground}`:\n\n{markdown_table(header, body)}"


def way_back(rows: pd.DataFrame, seeds: int) -> str:
    """The return of the agents of soil under the rover's slips."""
    header = ["agent", *(f"{SOIL} → {slip}" for slip in SLIPS)]
    body = [
        [a, *(text_of(means_of(rows, a, SOIL, s), seeds) for s in SLIPS)] for a in rtd.ALGORITHMS
    ]
    return f"The way back, to the rover's slips:\n\n{markdown_table(header, body)}"


def claim_14(rows: pd.DataFrame, grounds: tuple[str, ...]) -> str:
    """The paper's claim 14 on each ground: of the agents of sine slip, `BEST` transfers best."""
    body = []
    for ground in grounds:
        best, margin = means_of(rows, BEST, TRANSFER_SLIP, ground), margin_on(rows, ground)
        effects = [
            Effect(f"over {name}", best, means_of(rows, name, TRANSFER_SLIP, ground), margin)
            for name in rtd.ALGORITHMS
            if name != BEST
        ]
        texts = "; ".join(effect.text() for effect in effects)
        verdict = combine([effect.verdict() for effect in effects])
        body.append([ground, f"±{margin:.3f}", verdict, texts])
    header = ["ground", "margin", "verdict", f"`{BEST}`, trained on {TRANSFER_SLIP}"]
    return f"The paper's claim 14, on soil:\n\n{markdown_table(header, body)}"


def against(rows: pd.DataFrame, grounds: tuple[str, ...]) -> str:
    """The differences of training on soil and on each slip, and of each training and a controller.

    The controller is the one with the best mean return on the ground.
    """
    body = []
    for ground in grounds:
        plain = {name: means_of(rows, name, UNTRAINED, ground) for name in untrained(rows)}
        best = max(plain, key=lambda name: plain[name].mean())
        effect = functools.partial(Effect, margin=margin_on(rows, ground))
        for name in rtd.ALGORITHMS:
            of = {source: means_of(rows, name, source, ground) for source in COLOURS}
            effects = [
                *(effect(f"{name}: {SOIL} over {s}", of[SOIL], of[s]) for s in SLIPS),
                *(effect(f"{name}: {s} over {best}", of[s], plain[best]) for s in COLOURS),
            ]
            there = [e for e in effects if len(e.better) and len(e.worse)]
            body += [[ground, found.text(), found.verdict()] for found in there]
    header = ["tested on", "difference of means [95% interval]", "that it is positive"]
    return markdown_table(header, body)


def tables(rows: pd.DataFrame, grounds: tuple[str, ...], seeds: int) -> str:
    """A table for each ground, the way back, claim 14, and the differences."""
    parts = [returns_on(rows, ground, seeds) for ground in grounds]
    parts += [way_back(rows, seeds), claim_14(rows, grounds), against(rows, grounds)]
    return "\n\n".join(parts)


def draw(rows: pd.DataFrame, grounds: tuple[str, ...], out: pathlib.Path) -> None:
    """Draw the cost of each agent and controller, a panel for each ground, as rover_soil.png."""
    figure = Figure(figsize=(3.4 * len(grounds) + 1.0, 3.8), layout="constrained")
    panels = figure.subplots(1, len(grounds), sharey=True, squeeze=False)[0]
    for axes, ground in zip(panels, grounds, strict=True):
        for k, (source, colour) in enumerate(COLOURS.items()):
            for i, name in enumerate(rtd.ALGORITHMS):
                costs = -means_of(rows, name, source, ground)
                at = np.full(len(costs), i + 0.24 * (k - 1))
                axes.plot(at, costs, "o", color=colour, markersize=3.5, alpha=0.8)
            axes.plot([], [], "o", color=colour, label=f"trained on {source}")
        for name, style in CONTROLLER_LINES.items():
            cost = -means_of(rows, name, UNTRAINED, ground).mean()
            axes.axhline(cost, color="#777777", linestyle=style, linewidth=1, label=name)
        axes.set_yscale("log")
        axes.set_title(f"on {ground}")
        axes.set_xticks(range(len(rtd.ALGORITHMS)), rtd.ALGORITHMS, rotation=40, ha="right")
        axes.grid(axis="y", alpha=0.3)
    panels[0].set_ylabel("minus the return (lower is better)")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(handles), fontsize=8)
    figure.savefig(out / "rover_soil.png", dpi=150)
