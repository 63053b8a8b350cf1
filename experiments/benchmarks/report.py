"""The benchmark's table, goals and picture, from its measurements."""

import contextlib
import dataclasses
import importlib.metadata
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.benchmarks.ours import make_config
from experiments.benchmarks.torch_processes import ONE_PROCESS, PROCESS_PER_CORE
from rtd3jax.agents.variants import ALGORITHMS
from rtd3jax.study.colours import colour_of
from rtd3jax.study.flops import update_flops
from rtd3jax.system.files import write_bytes_atomically

COLUMNS = ["agent", "history_length", "measurement", "repeat", "value", "machine"]
ONE_STREAM = "lstm-td3-1ha1hc"
BASE = ("lstm-td3", 1)
"""The cell with which the paper's figure compares iteration times."""

# Names of measurements: rates in seed-steps/s, products in operations/s, compilation in s.
SGEMM, SGEMM_NUMPY, SGEMM_TORCH = "sgemm, XLA", "sgemm, numpy", "sgemm, torch"
LARGE_REPLAY, SMALL_REPLAY = "large replay", "small replay"
MANY_LANES, FEW_LANES = "many lanes", "few lanes"
COLD, CACHED = "compile, new process", "compile, from cache"


def ours(precision: str) -> str:
    """The name of the rate of rtd3jax."""
    return f"rtd3jax {precision}"


def compiling(precision: str) -> str:
    """The name of the compilation time of rtd3jax."""
    return f"compile {precision}"


def cell(table: pd.DataFrame, agent: str, length: int) -> pd.DataFrame:
    """The rows of one agent at one length."""
    return table[(table["agent"] == agent) & (table["history_length"] == length)]


@dataclasses.dataclass(frozen=True)
class Spread:
    """The median of repeats, and their extremes."""

    median: float
    low: float
    high: float

    def text(self, digits: int = 2) -> str:
        """``median (low–high)``."""
        return f"{self.median:.{digits}f} ({self.low:.{digits}f}–{self.high:.{digits}f})"


def spread(values: np.ndarray | None) -> Spread | None:
    """The spread of repeats; None without repeats."""
    if values is None or not len(values):
        return None
    return Spread(float(np.median(values)), float(np.min(values)), float(np.max(values)))


class Table:
    """Results from the measurements; None for missing measurements."""

    def __init__(self, measurements: pd.DataFrame, hidden_size: int, batch_size: int):
        self._rows, self._width, self._batch = measurements, hidden_size, batch_size

    def cells(self) -> list[tuple[str, int]]:
        """Agent and length of the cells with a rate of rtd3jax, in the order of the agents."""
        rows = self._rows[self._rows["measurement"] == ours("float32")]
        pairs = set(zip(rows["agent"], rows["history_length"].astype(int), strict=True))
        return sorted(pairs, key=lambda pair: (ALGORITHMS.index(pair[0]), pair[1]))

    def values(self, agent: str, length: int, name: str) -> np.ndarray | None:
        """The repeats of a measurement, in order."""
        rows = cell(self._rows, agent, length)
        rows = rows[rows["measurement"] == name].sort_values("repeat")
        return rows["value"].to_numpy(float) if len(rows) else None

    def torch(self, agent: str, length: int) -> tuple[str, np.ndarray] | None:
        """The better of PyTorch's two ways, by the median, and its rates."""
        found = [
            (way, values)
            for way in (ONE_PROCESS, PROCESS_PER_CORE)
            if (values := self.values(agent, length, way)) is not None
        ]
        return max(found, key=lambda pair: np.median(pair[1])) if found else None

    def against_torch(self, agent: str, length: int) -> np.ndarray | None:
        """The float32 rate of rtd3jax divided by PyTorch's, for each round."""
        theirs = self.torch(agent, length)
        return _ratio(self.values(agent, length, ours("float32")), theirs and theirs[1])

    def bfloat16(self, agent: str, length: int) -> np.ndarray | None:
        """The bfloat16 rate divided by the float32 rate, for each round."""
        rates = [self.values(agent, length, ours(p)) for p in ("bfloat16", "float32")]
        return _ratio(*rates)

    def sgemm(self, agent: str, length: int) -> np.ndarray | None:
        """Operations per second of large products with this cell: the fastest library, by round."""
        names = (SGEMM, SGEMM_NUMPY, SGEMM_TORCH)
        found = [v for name in names if (v := self.values(agent, length, name)) is not None]
        return max(found, key=np.median) if found else None

    def flops(self, agent: str, length: int) -> float:
        """Operations of a step's updates."""
        sizes = {"hidden_size": self._width, "batch_size": self._batch}
        return update_flops(make_config(agent, length, **sizes))

    def share(self, agent: str, length: int) -> np.ndarray | None:
        """The updates' operations per second divided by those of large products, for each round."""
        rates = self.values(agent, length, ours("float32"))
        scaled = None if rates is None else rates * self.flops(agent, length)
        return _ratio(scaled, self.sgemm(agent, length))

    def relative_time(self, agent: str, length: int, base: tuple[str, int]) -> float | None:
        """Median iteration time divided by the median of ``base``."""
        rates = [self.values(*pair, ours("float32")) for pair in (base, (agent, length))]
        if rates[0] is None or rates[1] is None:
            return None
        return float(np.median(rates[0]) / np.median(rates[1]))

    def pair(self, agent: str, length: int, first: str, second: str) -> np.ndarray | None:
        """One measurement divided by another, for each round."""
        return _ratio(self.values(agent, length, first), self.values(agent, length, second))


def _ratio(above: np.ndarray | None, below: np.ndarray | None) -> np.ndarray | None:
    """The ratio for each round that both have."""
    if above is None or below is None:
        return None
    rounds = min(len(above), len(below))
    return above[:rounds] / below[:rounds]


@dataclasses.dataclass(frozen=True)
class Goal:
    """A goal and its measurement; the bound is a minimum if ``at_least``, else a maximum."""

    what: str
    bound: float
    value: float | None
    at_least: bool = True

    @property
    def met(self) -> bool | None:
        """Whether the goal is reached; None without a measurement."""
        if self.value is None:
            return None
        return self.value >= self.bound if self.at_least else self.value <= self.bound


def goals(table: Table) -> list[Goal]:
    """All goals, by medians."""

    def median(values: np.ndarray | None) -> float | None:
        return None if values is None else float(np.median(values))

    agent = ONE_STREAM
    lengths = (1, 3, 6, 10, 20)
    ratios = [median(table.against_torch(agent, length)) for length in lengths]
    known = [ratio for ratio in ratios if ratio is not None]
    mean = float(np.exp(np.mean(np.log(known)))) if len(known) == len(lengths) else None
    h_td3 = table.relative_time(agent, 20, ("h-td3", 20))
    # Times are the inverses of rates.
    replay = median(table.pair(agent, 1, SMALL_REPLAY, LARGE_REPLAY))
    many = median(table.pair(agent, 10, FEW_LANES, MANY_LANES))
    compiling = [median(table.values(agent, 10, name)) for name in (COLD, CACHED)]
    return [
        Goal(f"share of sgemm, {agent}, l = 20", 0.80, median(table.share(agent, 20))),
        Goal(f"rate over PyTorch's, {agent}, l = 1", 2.5, ratios[0]),
        Goal(f"rate over PyTorch's, {agent}, l = 20", 1.3, ratios[-1]),
        Goal(f"rate over PyTorch's, {agent}, geometric mean of five lengths", 1.8, mean),
        Goal("bfloat16 rate over float32's, l = 20", 1.6, median(table.bfloat16(agent, 20))),
        Goal(f"h-td3's rate over that of {agent}, l = 20", 3.5, h_td3),
        Goal("step time, replay of 1,000,000 over 10,000, l = 1", 1.05, replay, False),
        Goal("time per lane, 8 lanes over 2, l = 10", 1.05, many, False),
        Goal("compiling one program in a new process, s", 8.0, compiling[0], False),
        Goal("the same from JAX's persistent cache, s", 1.5, compiling[1], False),
    ]


def markdown(measurements: pd.DataFrame, hidden_size: int, batch_size: int) -> str:
    """The table, the paper's claim about iteration times, and the goals."""
    table = Table(measurements, hidden_size, batch_size)
    head = (
        *("agent", "l", "compile, s", "seed-steps/s", "bfloat16", "bfloat16 ÷ float32"),
        *("PyTorch", "in", "rtd3jax ÷ PyTorch", "MFLOP a step", "share of sgemm"),
        "iteration time ÷ lstm-td3, l = 1",
    )
    rows = [list(_row(table, *pair)) for pair in table.cells()]
    # A column without measurements is left out.
    kept = [i for i in range(len(head)) if any(row[i] for row in rows)]
    lines = [
        "# Speed",
        "",
        f"Batch {batch_size}, width {hidden_size}, five seeds on the rover under AR(1) slip, on "
        f"{', '.join(sorted(set(measurements['machine'])))}: medians of "
        f"{measurements['repeat'].max() + 1} rounds (lowest–highest). {_versions()}.",
        "",
        _line([head[i] for i in kept]),
        _line(["---"] * len(kept)),
        *(_line([row[i] or "–" for i in kept]) for row in rows),
        "",
        *_products(table),
        *_claim(table),
        "| goal | bound | measured | met |",
        "|---|---|---|---|",
    ]
    for goal in goals(table):
        sign = "≥" if goal.at_least else "≤"
        measured = "–" if goal.value is None else f"{goal.value:.2f}"
        verdict = {True: "yes", False: "**no**", None: "not measured"}[goal.met]
        lines.append(f"| {goal.what} | {sign} {goal.bound:g} | {measured} | {verdict} |")
    return "\n".join(lines) + "\n"


def _versions() -> str:
    """Versions of the compared packages."""
    found = []
    for name in ("jax", "numpy", "torch"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found.append(f"{name} {importlib.metadata.version(name)}")
    return ", ".join(found)


def _row(table: Table, agent: str, length: int) -> Iterator[str]:
    """The columns of a cell; empty without measurements."""

    def show(values: np.ndarray | None, digits: int = 2) -> str:
        found = spread(values)
        return "" if found is None else found.text(digits)

    yield agent
    yield str(length) if length else "none"
    compiled = table.values(agent, length, compiling("float32"))
    yield "" if compiled is None else f"{compiled[0]:.1f}"
    yield show(table.values(agent, length, ours("float32")), 1)
    yield show(table.values(agent, length, ours("bfloat16")), 1)
    yield show(table.bfloat16(agent, length))
    theirs = table.torch(agent, length)
    yield "" if theirs is None else show(theirs[1], 1)
    yield "" if theirs is None else theirs[0].removeprefix("torch, ")
    yield show(table.against_torch(agent, length))
    yield f"{table.flops(agent, length) / 1e6:.0f}"
    yield show(table.share(agent, length))
    relative = table.relative_time(agent, length, BASE)
    yield "" if relative is None else f"{relative:.2f}"


def _products(table: Table) -> list[str]:
    """A sentence about the large products."""
    rates = {}
    for name in (SGEMM, SGEMM_NUMPY, SGEMM_TORCH):
        found = [v for pair in table.cells() if (v := table.values(*pair, name)) is not None]
        if found:
            rates[name.removeprefix("sgemm, ")] = np.median(np.concatenate(found)) / 1e9
    if not rates:
        return []
    listed = ", ".join(f"{rate:.0f} by {name}" for name, rate in rates.items())
    return [
        f"Large products (GFLOP/s on all cores, medians of the whole run): {listed}. Each cell's "
        "share is of the fastest beside it.",
        "",
    ]


def _claim(table: Table) -> list[str]:
    """The paper's claim: h-td3 has the shortest iteration, and depends least on the window."""
    rates = {
        pair: float(np.median(values))
        for pair in table.cells()
        if pair[0] != "td3" and (values := table.values(*pair, ours("float32"))) is not None
    }
    agents = {agent for agent, _ in rates}
    lengths = sorted({length for _, length in rates})
    complete = all((agent, length) in rates for agent in agents for length in lengths)
    if "h-td3" not in agents or len(agents) < 2 or len(lengths) < 2 or not complete:
        return []
    fastest = [length for length in lengths if _first(rates, agents, length) == "h-td3"]
    slowing = {agent: rates[agent, lengths[0]] / rates[agent, lengths[-1]] for agent in agents}
    least = min(slowing, key=lambda agent: slowing[agent])
    factors = ", ".join(f"{agent} {slowing[agent]:.1f}" for agent in ALGORITHMS if agent in slowing)
    return [
        f"The paper's claim 10: h-td3 has the shortest iteration of the recurrent agents at "
        f"{len(fastest)} of {len(lengths)} lengths; from l = {lengths[0]} to {lengths[-1]} an "
        f"iteration grows least in {least} (factors: {factors}).",
        "",
    ]


def _first(rates: dict[tuple[str, int], float], agents: set[str], length: int) -> str:
    return max(agents, key=lambda agent: rates[agent, length])


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def picture(measurements: pd.DataFrame, path: Path, hidden_size: int, batch_size: int) -> None:
    """Plot iteration time, rate divided by PyTorch's, and share of sgemm over window length."""
    table = Table(measurements, hidden_size, batch_size)

    def relative(agent: str, length: int) -> np.ndarray | None:
        time = table.relative_time(agent, length, BASE)
        return None if time is None else np.array([time])

    panels = (
        ("iteration time ÷ lstm-td3 at l = 1", relative),
        ("seed-steps/s ÷ PyTorch's", table.against_torch),
        ("updates' operations/s ÷ large sgemm's", table.share),
    )
    pairs = table.cells()
    lengths = sorted({length for _, length in pairs if length}) or [1]
    figure = Figure(figsize=(11.5, 3.9), layout="constrained")
    for axes, (title, question) in zip(figure.subplots(1, 3), panels, strict=True):
        for agent in dict.fromkeys(agent for agent, _ in pairs):
            found = [(length, spread(question(a, length))) for a, length in pairs if a == agent]
            points = [(length, s) for length, s in found if s is not None]
            if points:
                _draw(axes, agent, points, lengths)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("window length l")
        axes.set_xticks(lengths)
        axes.set_ylim(bottom=0)
        axes.grid(color="#E4E4E4", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    handles, labels = figure.axes[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    write_bytes_atomically(path, buffer.getvalue())


def _draw(axes, agent: str, points: list[tuple[int, Spread]], lengths: list[int]) -> None:
    """Draw an agent's line with its extremes; td3 has no window, so its line spans all lengths."""
    x = [length for length, _ in points]
    shown = [s for _, s in points]
    dashes = "-"
    if agent == "td3":
        x, shown, dashes = [lengths[0], lengths[-1]], shown * 2, ":"
    middle = np.array([s.median for s in shown])
    error = np.array([[s.median - s.low for s in shown], [s.high - s.median for s in shown]])
    axes.errorbar(x, middle, error, linestyle=dashes, marker="o", markersize=3, capsize=2,
                  color=colour_of(agent), label=agent)  # fmt: skip
