"""The result of a fit."""

import dataclasses
import math
import os
from typing import NamedTuple

import numpy as np

from rtd3jax.envs.processes.process import Process


class Estimate(NamedTuple):
    """A parameter's value and its standard error.

    The error is NaN for an end of a range, and for a value at a bound.
    """

    value: float
    standard_error: float


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """The result of fitting a process to a log.

    Attributes:
        kind: "ar1", "sine", "ornstein-uhlenbeck" or "noise".
        process: the process with the estimated parameters.
        estimates: estimates by name; a field of the process has the same name.
        log_likelihood: log-likelihood of all values except the first of each sequence; for "ar1"
            and "ornstein-uhlenbeck", given the previous values.
        parameters: number of estimated parameters.
        error: root mean square residual, in the log's unit: the error of predicting a value from
            the previous value of the log; for "sine", the error of the fitted waves.
        method: the method of estimation, in a few words.
        notes: remarks on this fit, in sentences.
        sequences: the log, float64 [T, N] for each sequence.
        process_of_rows: the process whose steps are the rows of the log; None means ``process``.
    """

    kind: str
    process: Process
    estimates: dict[str, Estimate]
    log_likelihood: float
    parameters: int
    error: float
    method: str
    notes: tuple[str, ...]
    sequences: tuple[np.ndarray, ...] = dataclasses.field(repr=False)
    process_of_rows: Process | None = dataclasses.field(repr=False, default=None)

    @property
    def aic(self) -> float:
        """Akaike's criterion; compare it among fits to the same log, if no value is clipped."""
        return 2.0 * self.parameters - 2.0 * self.log_likelihood

    def summary(self) -> str:
        """The fit in a few lines of text."""
        rows = sum(len(part) for part in self.sequences)
        lines = [
            f"{self.kind}: {type(self.process).__name__}, by {self.method}",
            f"{len(self.sequences)} recordings, {rows:,} rows of {self.sequences[0].shape[1]}",
        ]
        width = max(map(len, self.estimates))
        for name, (value, error) in self.estimates.items():
            spread = "" if math.isnan(error) else f" ± {error:.2g}"
            lines.append(f"  {name:{width}}  {value:.5g}{spread}")
        lines.append(
            f"log-likelihood {self.log_likelihood:,.1f}, AIC {self.aic:,.1f} "
            f"({self.parameters} parameters), error {self.error:.4g}"
        )
        return "\n".join([*lines, *self.notes])

    def plot(self, path: str | os.PathLike, overwrite: bool = False, seed: int = 0) -> None:
        """Plot distribution, autocorrelation and spectrum of recorded and simulated sequences.

        All are at the rate of the log, also if the fit is converted to that of the environment.

        Args:
            path: path of the picture; the suffix chooses the format (.png, .svg, .pdf).
            overwrite: whether to replace an existing file.
            seed: seed of the simulated episodes.

        Raises:
            UserError: when the file exists and ``overwrite`` is false, or cannot be written.
        """
        from rtd3jax.identification.picture import draw_fit

        process = self.process if self.process_of_rows is None else self.process_of_rows
        unit = "step" if process == self.process else "row"
        draw_fit(self.kind, process, self.sequences, path, overwrite, seed, unit)
