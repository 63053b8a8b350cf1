"""Offsets: a wandering bias, and white noise."""

import math
from collections.abc import Sequence

import numpy as np

from rtd3jax.envs.processes.disturbances import GaussianNoise
from rtd3jax.envs.processes.faults import OrnsteinUhlenbeck
from rtd3jax.errors import UserError
from rtd3jax.identification.result import Estimate, Fit


def fit_ornstein_uhlenbeck(parts: Sequence[np.ndarray], max_slip: float | None = None) -> Fit:
    """`OrnsteinUhlenbeck`: the regression of every value on the one before it.

    That maximises the likelihood given each first value, exactly. Errors come by the delta method
    from those of the regression.
    """
    before, after = transitions(parts)
    count = before.size
    centre, spread = before.mean(), before.var()
    if spread == 0.0:
        raise UserError("all values but the last are the same: there is nothing to fit")
    decay = float(np.mean((before - centre) * (after - after.mean())) / spread)
    level = float(after.mean() - decay * centre)
    residual = after - level - decay * before
    variance = float(np.mean(residual**2))
    if not 0.0 < decay < 1.0:
        reason = "wanders off without end" if decay >= 1.0 else "has no memory, or alternates"
        raise UserError(
            f"ornstein-uhlenbeck: the log's autocorrelation at one step is {decay:.3g}: it "
            f'{reason}; record longer, or fit "noise"'
        )
    if variance == 0.0:
        raise UserError("ornstein-uhlenbeck: the log has no noise in it: nothing is random")
    mean = level / (1.0 - decay)
    sigma = math.sqrt(variance / (1.0 - decay**2))
    constant = -1.0 / math.log(decay)
    # Information of (mean, decay) about the mean, where it is diagonal; the variance is apart.
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
    """`GaussianNoise`: the root mean square, for the process has no mean."""
    # As the others do, it counts the values that have one before them, so that AIC compares.
    _, values = transitions(parts)
    variance = float(np.mean(values**2))
    mean, error = float(values.mean()), float(values.std()) / math.sqrt(values.size)
    notes = []
    if abs(mean) > 4.0 * error:
        notes.append(
            f"The log's mean is {mean:.4g} and GaussianNoise has none: sigma covers it. "
            'Subtract it, or fit "ornstein-uhlenbeck".'
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
    """Every value that has one after it in its stretch, and that one: float64 [K] each."""
    before = np.concatenate([part[:-1].ravel() for part in parts])
    after = np.concatenate([part[1:].ravel() for part in parts])
    return before, after


def gaussian(residual: np.ndarray, variance: float) -> float:
    """The log-likelihood of residuals under their own variance."""
    return -0.5 * residual.size * (math.log(2.0 * math.pi * variance) + 1.0)
