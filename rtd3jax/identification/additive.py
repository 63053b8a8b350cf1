"""Fits of processes that add an offset: a random bias, and white noise."""

import math
from collections.abc import Sequence

import numpy as np

from rtd3jax.envs.processes.disturbances import GaussianNoise
from rtd3jax.envs.processes.faults import OrnsteinUhlenbeck
from rtd3jax.errors import UserError
from rtd3jax.identification.result import Estimate, Fit

ENOUGH = 20.0
"""Time constants of a log of which the 95% intervals cover the truth in at least 90% of logs."""


def fit_ornstein_uhlenbeck(
    parts: Sequence[np.ndarray], max_slip: float | None = None, rows_per_step: float = 1.0
) -> Fit:
    """Fit `OrnsteinUhlenbeck` by the regression of each value on the previous value.

    This regression maximises the likelihood, given the first value of each sequence. In short logs,
    its coefficient is too small; the bias is removed (Kendall, Biometrika 41, 1954). The delta
    method gives the standard errors from those of the regression. The time constant is in steps of
    the environment, of which each has ``rows_per_step`` rows of the log.
    """
    before, after = transitions(parts)
    count = before.size
    centre, spread = before.mean(), before.var()
    if spread == 0.0:
        raise UserError("all values except the last are equal: nothing can be fitted")
    decay = float(np.mean((before - centre) * (after - after.mean())) / spread)
    if not 0.0 < decay < 1.0:
        reason = "is not stationary" if decay >= 1.0 else "has no memory, or alternates"
        raise UserError(
            f"ornstein-uhlenbeck: the autocorrelation at one step is {decay:.3g}, so the log "
            f'{reason}; record longer, or fit "noise"'
        )
    if np.mean((after - after.mean() - decay * (before - centre)) ** 2) <= 1e-24 * spread:
        raise UserError("ornstein-uhlenbeck: the log has no random part")
    # The expectation of the coefficient is decay - (1 + 3 decay) / count.
    corrected, most = (count * decay + 1.0) / (count - 3.0), math.exp(-1.0 / count)
    decay = min(corrected, most)
    level = float(after.mean() - decay * centre)
    residual = after - level - decay * before
    variance = float(np.mean(residual**2))
    mean = level / (1.0 - decay)
    sigma = math.sqrt(variance / (1.0 - decay**2))
    constant = -1.0 / math.log(decay)
    # Information matrix of (mean, decay), which is diagonal around the mean. The variance is
    # independent of both.
    decay_error = math.sqrt(variance / (count * float(np.mean((before - mean) ** 2))))
    mean_error = math.sqrt(variance / count) / (1.0 - decay)
    variance_error = variance * math.sqrt(2.0 / count)
    by_variance, by_decay = sigma / (2.0 * variance), sigma * decay / (1.0 - decay**2)
    sigma_error = math.hypot(by_variance * variance_error, by_decay * decay_error)
    constant_error = decay_error / (decay * math.log(decay) ** 2)
    notes = []
    if corrected > most:
        notes.append(
            "The log cannot tell its time constant from a longer one; it was limited to the number "
            "of values. Record longer."
        )
    if count < ENOUGH * constant:
        notes.append(
            f"The log only holds {count / constant:.2g} time constants, so the intervals are too "
            f"narrow; they need {ENOUGH:g}."
        )
    process = OrnsteinUhlenbeck(sigma=sigma, time_constant=constant / rows_per_step, mean=mean)
    coefficient = decay**rows_per_step
    return Fit(
        kind="ornstein-uhlenbeck",
        process=process,
        estimates={
            "sigma": Estimate(sigma, sigma_error),
            "time_constant": Estimate(constant / rows_per_step, constant_error / rows_per_step),
            "mean": Estimate(mean, mean_error),
            "coefficient": Estimate(coefficient, rows_per_step * coefficient / decay * decay_error),
        },
        log_likelihood=gaussian(residual, variance),
        parameters=3,
        error=math.sqrt(variance),
        method="maximum likelihood given each first value, corrected for the bias of short logs",
        notes=tuple(notes),
        sequences=tuple(parts),
        process_of_rows=process.replace(time_constant=constant),
    )


def fit_noise(
    parts: Sequence[np.ndarray], max_slip: float | None = None, rows_per_step: float = 1.0
) -> Fit:
    """Fit `GaussianNoise` by the root mean square, because the process has zero mean.

    White noise is the same at every rate, so ``rows_per_step`` does not matter.
    """
    # As in the other fits, only values with a previous value count, so that AIC is comparable.
    _, values = transitions(parts)
    variance = float(np.mean(values**2))
    if variance == 0.0:
        raise UserError("noise: all values except the first are zero, so nothing can be fitted")
    mean, error = float(values.mean()), float(values.std()) / math.sqrt(values.size)
    notes = []
    if abs(mean) > 4.0 * error:
        notes.append(
            f"The mean of the log is {mean:.4g}, but GaussianNoise has zero mean, so sigma "
            'contains it. Subtract the mean, or fit "ornstein-uhlenbeck".'
        )
    sigma = math.sqrt(variance)
    return Fit(
        kind="noise",
        process=GaussianNoise(sigma=sigma),
        estimates={"sigma": Estimate(sigma, sigma / math.sqrt(2.0 * values.size))},
        log_likelihood=gaussian(values, variance),
        parameters=1,
        error=sigma,
        method="maximum likelihood",
        notes=tuple(notes),
        sequences=tuple(parts),
    )


def transitions(parts: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of a value and the next value of its sequence: float64 [K] each."""
    before = np.concatenate([part[:-1].ravel() for part in parts])
    after = np.concatenate([part[1:].ravel() for part in parts])
    return before, after


def gaussian(residual: np.ndarray, variance: float) -> float:
    """The log-likelihood of normal residuals with the given variance."""
    return -0.5 * residual.size * (math.log(2.0 * math.pi * variance) + 1.0)
