"""`fit_process`: estimates the parameters of a process from a log."""

import dataclasses
import os
from collections.abc import Callable, Sequence

import numpy as np

from rtd3jax.envs.log import read_log
from rtd3jax.envs.processes.recorded import Recorded
from rtd3jax.errors import UserError, nearest
from rtd3jax.identification.additive import fit_noise, fit_ornstein_uhlenbeck
from rtd3jax.identification.ar1 import fit_ar1
from rtd3jax.identification.result import Fit
from rtd3jax.identification.sine import fit_sine

_FITS: dict[str, Callable[[Sequence[np.ndarray], float | None], Fit]] = {
    "ar1": fit_ar1,
    "sine": fit_sine,
    "ornstein-uhlenbeck": fit_ornstein_uhlenbeck,
    "noise": fit_noise,
}
KINDS: tuple[str, ...] = tuple(_FITS)
_OF_SLIP = ("ar1", "sine")


def fit_process(
    log: object,
    kind: str,
    *,
    columns: Sequence[str] | str | None = None,
    episode: str | None = None,
    period: float | None = None,
    step: float | None = None,
    max_slip: float | None = None,
) -> Fit:
    """Fit a process to all episodes and elements of a log together.

    | kind | process | what the log holds | method |
    |---|---|---|---|
    | "ar1" | `Ar1Slip` | slip, 0 to 1 | maximum likelihood given each first value; a clipped \
value contributes a probability |
    | "sine" | `SineSlip` | slip, 0 to 1 | least squares of each wave, the period by its profile |
    | "ornstein-uhlenbeck" | `OrnsteinUhlenbeck` | an offset | maximum likelihood given each first \
value |
    | "noise" | `GaussianNoise` | an offset | maximum likelihood; the process has zero mean |

    Args:
        log: a log as for `rtd3jax.Recorded`, or a `rtd3jax.Recorded`, such as the first part of a
            split.
        kind: one of the kinds above.
        columns: as for `rtd3jax.Recorded`.
        episode: the column that numbers the episodes.
        period: time in s between two samples of the log.
        step: time in s between two steps of the environment.
        max_slip: upper bound of the slip, for "ar1" and "sine"; by default the largest in the log.

    Returns:
        The fitted process, ready for `rtd3jax.disturb` or the rover's ``slip``; estimates with
        standard errors; the likelihood; ``summary()`` and ``plot(path)``.

    Raises:
        UserError: for a log that cannot be read, or to which the process cannot be fitted.
    """
    if kind not in KINDS:
        raise UserError(
            f"kind {kind!r} must be one of {', '.join(KINDS)}{nearest(str(kind), KINDS)}"
        )
    if isinstance(log, Recorded):
        given = {"columns": columns, "episode": episode, "period": period, "step": step}
        for name, value in given.items():
            if value is not None:
                raise UserError(f"{name}= is for a log, not for a Recorded, which was read before")
        low, high = np.asarray(log.low), np.asarray(log.high)
        parts = [np.clip(part, low, high).astype(np.float64) for part in log.sequences()]
    else:
        if isinstance(log, str | os.PathLike) and not str(log):
            raise UserError("the log's path is empty; name a CSV or Parquet file")
        parts = read_log(log, columns, episode, period, step)
    if max_slip is not None:
        if kind not in _OF_SLIP:
            raise UserError(f"max_slip is a parameter of {' and '.join(_OF_SLIP)}, not of {kind}")
        number = isinstance(max_slip, float | int | np.number) and not isinstance(max_slip, bool)
        if not number or not 0.0 < max_slip <= 1.0:
            raise UserError(f"max_slip={max_slip!r} must be greater than 0 and at most 1")
    parts = [part for part in parts if len(part) > 1]
    values = sum(part.size for part in parts)
    if values < 10:
        raise UserError(
            f"{values} values in sequences of two or more rows are too few to fit; record longer"
        )
    if np.ptp(np.concatenate([part.ravel() for part in parts])) == 0.0:
        raise UserError("all values of the log are equal: nothing can be fitted")
    fit = _FITS[kind](parts, max_slip)
    elements = log.elements if isinstance(log, Recorded) else ()
    return _of_elements(fit, elements) if elements else fit


def _of_elements(fit: Fit, elements: tuple[int, ...]) -> Fit:
    """The fit, whose process disturbs the elements that the recording disturbs."""
    if hasattr(fit.process, "elements"):
        return dataclasses.replace(fit, process=fit.process.replace(elements=elements))
    note = (
        f"The recording disturbs the elements {list(elements)}, but {type(fit.process).__name__} "
        "disturbs all."
    )
    return dataclasses.replace(fit, notes=(*fit.notes, note))
