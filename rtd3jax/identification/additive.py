"""Fits of processes that add an offset: a random bias, and white noise."""

import math
from collections.abc import Sequence

import numpy as np

from rtd3jax.envs.processes.disturbances import GaussianNoise
from rtd3jax.envs.processes.faults import OrnsteinUhlenbeck
from rtd3jax.errors import UserError
from rtd3jax.identification.result import Estimate, Fit


def fit_ornstein_uhlenbeck(parts: Sequence[np.ndarray], max_slip: float | None = None) -> Fit:
    """Fit `OrnsteinUhlenbeck` by the regression of each value on the previous value.

    This regression maximises the likelihood, given the first value of each sequence. The delta
    method gives the standard errors from those of the regression.
    """
    before, after = transitions(parts)
    count = before.size
    centre, spread = before.mean(), before.var()
    if spread == 0.0:
        raise UserError("all values except the last are equal: nothing can be fitted")
    decay = float(np.mean((before - centre) * (after - after.mean())) / spread)
    level = float(after.mean() - decay * centre)
    residual = after - level - decay * before
    variance = float(np.mean(residual**2))
    if not 0.0 < decay < 1.0:
        reason = "is not stationary" if decay >= 1.0 else "has no memory, or alternates"
        raise UserError(
            f"ornstein-uhlenbeck: the autocorrelation at one step is {decay:.3g}, so the log "
            f'{reason}; record longer, or fit "noise"'
        )
    if variance == 0.0:
        raise UserError("ornstein-uhlenbeck: the log has no random part")
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
    return Fit(
        kind="ornstein-uhlenbeck",
        process=OrnsteinUhlenbeck(sigma=sigma, time_constant=constant, mean=mean),
        estimates={
            "sigma": Estimate(sigma, sigma_error),
            "time_constant": Estimate(constant, constant_error),
            "mean": Estimate(mean, mean_error),
            "coefficient": Estimate(decay, decay_error),
        },
        log_likelihood=gaussian(residual, variance),
        parameters=3,
        error=math.sqrt(variance),
        method="maximum likelihood given each first value",
        notes=(),
        sequences=tuple(parts),
    )


def fit_noise(parts: Sequence[np.ndarray], max_slip: float | None = None) -> Fit:
    """Fit `GaussianNoise` by the root mean square, because the process has zero mean."""
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
