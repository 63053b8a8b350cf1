"""What a fit found."""

import dataclasses
import math
import os
from typing import NamedTuple

import numpy as np

from rtd3jax.envs.processes.process import Process


class Estimate(NamedTuple):
    """A parameter's value and its standard error.

    The error is NaN where there is none: at the end of a range, or of a bound.
    """

    value: float
    standard_error: float


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """A process that was fitted to a log.

    Attributes:
        kind: "ar1", "sine", "ornstein-uhlenbeck" or "noise".
        process: with the estimated parameters.
        estimates: by name; those that are fields of the process have its names.
        log_likelihood: of the values given those that came before them.
        parameters: how many were estimated.
        error: root mean square of what the process leaves unexplained, in the log's unit: the error
            of predicting a value from the one before it; under "sine", that of the fitted waves.
        method: in a few words.
        notes: what the user should know of this fit, in sentences.
        sequences: the log, float64 [T, N] for each stretch.
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

    @property
    def aic(self) -> float:
        """Akaike's criterion, less is better: of fits to the same log without clipped values."""
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
        """Draw recorded against fitted: distribution, autocorrelation, spectrum.

        Args:
            path: of the picture; its ending says the format (.png, .svg, .pdf).
            overwrite: replace a file that is there.
            seed: of the fitted process's episodes.

        Raises:
            UserError: when the file exists and ``overwrite`` is false, or cannot be written.
        """
        from rtd3jax.identification.picture import draw_fit

        draw_fit(self.kind, self.process, self.sequences, path, overwrite, seed)
