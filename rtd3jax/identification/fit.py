"""`fit_process`: estimates the parameters of a process from a log."""

import dataclasses
import os
from collections.abc import Callable, Sequence

import numpy as np

from rtd3jax.envs.log import read_log, rows_per_step
from rtd3jax.envs.processes.recorded import Recorded
from rtd3jax.errors import UserError, nearest
from rtd3jax.identification.additive import fit_noise, fit_ornstein_uhlenbeck
from rtd3jax.identification.ar1 import fit_ar1
from rtd3jax.identification.result import Fit
from rtd3jax.identification.sine import fit_sine

_FITS: dict[str, Callable[[Sequence[np.ndarray], float | None, float], Fit]] = {
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

    The fit is at the rate of the log. With ``period`` and ``step``, its parameters are then
    converted to the steps of the environment, since interpolated samples would bias them.

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
        period: time in s between two samples of the log, or of a `rtd3jax.Recorded` that was read
            without this argument.
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
        _check_reading(log, columns=columns, episode=episode, period=period, step=step)
        low, high = np.asarray(log.low), np.asarray(log.high)
        parts = [np.clip(part, low, high).astype(np.float64) for part in log.sequences()]
    else:
        if isinstance(log, str | os.PathLike) and not str(log):
            raise UserError("the log's path is empty; name a CSV or Parquet file")
        parts = read_log(log, columns, episode)
    rows = rows_per_step(period, step)
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
    fit = _FITS[kind](parts, max_slip, rows)
    notes = list(fit.notes)
    if rows != 1.0:
        notes.append(
            f"The parameters are those of steps of {step:g} s. The likelihood, the error and the "
            f"picture are those of the log, which has a row every {period:g} s."
        )
    fit = dataclasses.replace(fit, notes=(*notes, *_differing_elements(parts)))
    elements = log.elements if isinstance(log, Recorded) else ()
    return _of_elements(fit, elements) if elements else fit


def _check_reading(log: Recorded, **given: object) -> None:
    """Raise UserError if ``log`` is interpolated, or for an argument that only acts on reading."""
    if not log.log_rows_per_step.is_integer():
        raise UserError(
            "the recording was interpolated when it was read, which biases a fit: read it without "
            "period= and step=, and pass both to fit_process instead"
        )
    once = log.log_rows_per_step == 1.0
    for name, value in given.items():
        if value is not None and not (once and name in ("period", "step")):
            raise UserError(f"{name}= is for a log, not for a Recorded, which was read before")


def _differing_elements(parts: Sequence[np.ndarray]) -> list[str]:
    """A note if the means or the deviations of the elements are too different to be pooled."""
    rows = np.concatenate(parts)
    means, deviations = rows.mean(axis=0), rows.std(axis=0)
    apart = np.ptp(means) > 1.5 * np.sqrt(np.mean(deviations**2))
    if not apart and deviations.max() <= 2.0 * deviations.min():
        return []
    return [
        f"The elements differ: means {_from_to(means)}, standard deviations "
        f"{_from_to(deviations)}. The parameters are the same for all elements, so they describe "
        "none of these: fit each element alone, with columns=[...] or a column of the array."
    ]


def _from_to(values: np.ndarray) -> str:
    return f"from {values.min():.3g} to {values.max():.3g}"


def _of_elements(fit: Fit, elements: tuple[int, ...]) -> Fit:
    """The fit, whose process disturbs the elements that the recording disturbs."""
    if hasattr(fit.process, "elements"):
        return dataclasses.replace(fit, process=fit.process.replace(elements=elements))
    note = (
        f"The recording disturbs the elements {list(elements)}, but {type(fit.process).__name__} "
        "disturbs all."
    )
    return dataclasses.replace(fit, notes=(*fit.notes, note))
