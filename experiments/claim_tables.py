"""The tables of the experiments, as experiments/claims.py reads them."""

import dataclasses
import pathlib
from collections.abc import Collection

import numpy as np
import pandas as pd
from effects import FEWEST_SEEDS
from pendulum_cells import current_setting

from rtd3jax.study import presets

CELL = ["algorithm", "disturbance", "history_length"]


@dataclasses.dataclass(frozen=True)
class Trainings:
    """A value of each training on the pendulum: the columns of `CELL`, ``seed`` and ``normalised``.

    Cells with fewer seeds than a verdict needs do not count.
    """

    table: pd.DataFrame

    def lengths(self, algorithm: str, disturbance: str) -> list[int]:
        """Window lengths with which the agent was trained under the disturbance; 0: no window."""
        return list(self._cells(algorithm, disturbance))

    def values(
        self, algorithm: str, disturbance: str, lengths: Collection[int]
    ) -> list[np.ndarray]:
        """An array of seeds for each of the lengths; one array for an agent without a window."""
        cells = self._cells(algorithm, disturbance)
        return [values for length, values in cells.items() if length in (0, *lengths)]

    def compared(self, *sides: tuple[str, str]) -> tuple[str, list[list[np.ndarray]]]:
        """The values of each agent and disturbance, with the same window lengths.

        While the trainings are incomplete, one side may have window lengths that another lacks.
        Only the lengths of all sides count; `td3`, which has no window, counts with each.

        Returns:
            The lengths, as text for the name of the effect, and for each side an array of seeds for
            each length.
        """
        windows = [set(self.lengths(*side)) for side in sides if side[0] != "td3"]
        shared = sorted(set.intersection(*windows)) if windows else []
        listed = f" (l = {', '.join(map(str, shared))})" if shared else ""
        return listed, [self.values(*side, shared) for side in sides]

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

    def _cells(self, algorithm: str, disturbance: str) -> dict[int, np.ndarray]:
        if self.table.empty:
            return {}
        own = _rows(self.table, {"algorithm": algorithm, "disturbance": disturbance})
        cells = own.sort_values("seed").groupby("history_length")["normalised"]
        return {int(n): cell.to_numpy() for n, cell in cells if len(cell) >= FEWEST_SEEDS}


@dataclasses.dataclass(frozen=True)
class Results:
    """The tables of the experiments; empty tables for experiments that were not run."""

    rover: pd.DataFrame
    pendulum: Trainings
    """Final returns."""
    curves: pd.DataFrame
    """Learning curves on the pendulum."""
    generalisation: pd.DataFrame
    bench: pd.DataFrame

    @classmethod
    def read(cls, directory: pathlib.Path) -> "Results":
        """Read the directory of results."""
        names = ("rover", "pendulum", "pendulum_curves", "generalisation")
        files = [directory / f"{name}.parquet" for name in names]
        tables = [pd.read_parquet(file) if file.exists() else pd.DataFrame() for file in files]
        rover, *of_the_pendulum = tables
        pendulum, curves, generalisation = map(current, of_the_pendulum)
        bench = directory / "benchmarks" / "measurements.csv"
        rates = pd.read_csv(bench) if bench.exists() else pd.DataFrame()
        return cls(rover, Trainings(pendulum), curves, generalisation, rates)

    def on_rover(self, algorithm: str, trained: str, tested: str = "ar1-slip") -> np.ndarray:
        """Mean return of each seed."""
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

    def carried(self, algorithm: str, tested: str) -> list[np.ndarray]:
        """Normalised returns of an agent of `random-sine` under another condition, by length."""
        if self.generalisation.empty:
            return []
        rows = _rows(self.generalisation, {"algorithm": algorithm, "tested_on": tested})
        return [own["normalised"].to_numpy() for _, own in rows.groupby("history_length")]

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
