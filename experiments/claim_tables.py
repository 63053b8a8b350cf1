"""The tables of the experiments, as experiments/claims.py reads them."""

import dataclasses
import pathlib
from collections.abc import Collection
from typing import Any

import numpy as np
import pandas as pd
from effects import FEWEST_SEEDS, Effect
from pendulum_cells import current_setting
from settings import ROVER_SETTING

from rtd3jax.study import presets

CELL = ["algorithm", "disturbance", "history_length"]
LONGER = "pendulum_longer/pendulum"
"""The table of trainings with twice the steps (`pendulum.py --steps 60000`)."""


Cells = dict[int, np.ndarray]
"""The values of an agent under a disturbance, by window length: an array [seeds] each. An agent
without a window has length 0."""


def compare(
    name: str,
    better: list[Cells],
    worse: list[Cells],
    kind: type[Effect] = Effect,
    lengths: Collection[int] | None = None,
    other_tests: int = 0,
    **fields: Any,
) -> Effect:
    """The effect between means of cells, with the same window lengths on both sides.

    While the trainings are incomplete, some cells may have window lengths that others lack. Only
    lengths that all cells have count (and of these only ``lengths``, if they are given). An agent
    without a window counts with every length. The parts of the effect are the effects at each
    length, to which ``other_tests`` do not apply. ``fields`` are other fields of the effect.
    """
    windows = [set(cells) for cells in (*better, *worse) if set(cells) != {0}]
    shared = set.intersection(*windows) if windows else set()
    shared = sorted(shared if lengths is None else shared & set(lengths))

    def between(title: str, known: Collection[int], **more: Any) -> Effect:
        sides = [
            [[values for n, values in cells.items() if n in (0, *known)] for cells in side]
            for side in (better, worse)
        ]
        complete = all(all(side) for side in sides)
        return kind(title, *(sides if complete else ([], [])), **fields, **more)

    parts = [between(f"l = {length}", [length]) for length in shared] if len(shared) > 1 else []
    listed = f" (l = {', '.join(map(str, shared))})" if shared else ""
    return between(f"{name}{listed}", shared, parts=tuple(parts), other_tests=other_tests)


@dataclasses.dataclass(frozen=True)
class Trainings:
    """A value of each training on the pendulum: the columns of `CELL`, ``seed`` and ``normalised``.

    Cells with fewer seeds than a verdict needs do not count.
    """

    table: pd.DataFrame

    def of(self, algorithm: str, disturbance: str) -> Cells:
        """The cells of an agent under a disturbance; seeds are in their order."""
        if self.table.empty:
            return {}
        own = _rows(self.table, {"algorithm": algorithm, "disturbance": disturbance})
        cells = own.sort_values("seed").groupby("history_length")["normalised"]
        return {int(n): cell.to_numpy() for n, cell in cells if len(cell) >= FEWEST_SEEDS}

    def likeness(self, across: str) -> float | None:
        """The correlation of trainings with the same seed that differ in ``across`` alone.

        What correlates is the deviation of a training from its cell's mean, in standard deviations.
        The result is None without such pairs.
        """
        if self.table.empty:
            return None
        values = self.table["normalised"]
        of_cells = self.table.groupby(CELL)["normalised"]
        deviation = (values - of_cells.transform("mean")) / of_cells.transform("std")
        rows = self.table[[*CELL, "seed"]].assign(deviation=deviation).dropna()
        pairs = rows.merge(rows, on=[*(name for name in CELL if name != across), "seed"])
        pairs = pairs[pairs[f"{across}_x"] != pairs[f"{across}_y"]]
        if pairs.empty:
            return None
        return round(float(pairs["deviation_x"].corr(pairs["deviation_y"])), 2)


@dataclasses.dataclass(frozen=True)
class Results:
    """The tables of the experiments; empty tables for experiments that were not run."""

    rover: pd.DataFrame
    pendulum: Trainings
    """Final returns."""
    curves: pd.DataFrame
    """Learning curves on the pendulum."""
    carried: Trainings
    """Returns, under other disturbances, of agents that were trained under `random-sine`."""
    bench: pd.DataFrame
    longer: Trainings = Trainings(pd.DataFrame())
    """Final returns after twice the steps."""

    @classmethod
    def read(cls, directory: pathlib.Path) -> "Results":
        """Read the directory of results."""
        names = ("rover", "pendulum", "pendulum_curves", "generalisation", LONGER)
        files = [directory / f"{name}.parquet" for name in names]
        tables = [pd.read_parquet(file) if file.exists() else pd.DataFrame() for file in files]
        rover, *of_the_pendulum = tables
        if "setting" in rover:
            rover = rover[rover["setting"] == ROVER_SETTING]
        pendulum, curves, generalisation, longer = map(current, of_the_pendulum)
        bench = directory / "benchmarks" / "measurements.csv"
        rates = pd.read_csv(bench) if bench.exists() else pd.DataFrame()
        carried = generalisation.rename(columns={"tested_on": "disturbance"})
        returns = Trainings(pendulum), curves, Trainings(carried)
        return cls(rover, *returns, rates, Trainings(longer))

    def on_rover(self, algorithm: str, trained: str, tested: str = "ar1-slip") -> np.ndarray:
        """Mean return of each seed: float [seeds]; empty without results."""
        key = {"algorithm": algorithm, "trained_on": trained, "tested_on": tested}
        if self.rover.empty:
            return np.empty(0)
        return _rows(self.rover, key).groupby("seed")["mean"].mean().to_numpy()

    def during(self, first: float, last: float) -> Trainings:
        """Mean returns of the evaluations in a part of the training.

        The part is given in fractions of `PENDULUM_STEPS`, for all agents: `h-td3` trains twice as
        long. Learning curves that are shorter are left out.
        """
        if self.curves.empty:
            return Trainings(self.curves)
        lane = [*CELL, "seed"]
        done = self.curves["step"] / presets.PENDULUM_STEPS
        complete = self.curves.groupby(lane)["step"].transform("max") >= presets.PENDULUM_STEPS
        part = self.curves[complete & (done > first) & (done <= last)]
        return Trainings(part.groupby(lane, as_index=False)["normalised"].mean())

    def rates(self, algorithm: str, length: int) -> np.ndarray:
        """Seed-steps per second in each round of the benchmark."""
        key = {"agent": algorithm, "history_length": length, "measurement": "rtd3jax float32"}
        return _rows(self.bench, key)["value"].to_numpy() if len(self.bench) else np.empty(0)


def current(table: pd.DataFrame) -> pd.DataFrame:
    """The rows with the current settings and the full size of each agent.

    Trainings with other settings, another width or another length are left out.
    """
    if table.empty:
        return table
    if "setting" in table:
        table = table[table["setting"] == table["algorithm"].map(current_setting)]
    for size in ("width", "steps"):
        if size in table and len(table):
            table = table[table[size] == table.groupby("algorithm")[size].transform("max")]
    return table


def _rows(table: pd.DataFrame, key: dict) -> pd.DataFrame:
    return table[(table[list(key)] == list(key.values())).all(axis=1)]
