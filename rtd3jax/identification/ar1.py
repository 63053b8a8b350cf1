"""Fits the rover's clipped first-order slip."""

import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import log_ndtr, ndtr

from rtd3jax.envs.rover.slip import Ar1Slip
from rtd3jax.errors import UserError
from rtd3jax.identification.additive import transitions
from rtd3jax.identification.result import Estimate, Fit
from rtd3jax.identification.slip import TOLERANCE, bounded_slip


def fit_ar1(
    parts: Sequence[np.ndarray], max_slip: float | None = None, rows_per_step: float = 1.0
) -> Fit:
    """Fit `Ar1Slip` by the likelihood of a censored regression (Tobin, Econometrica 26, 1958).

    A slip within the bounds contributes its density; a slip at a bound contributes the probability
    of all values beyond the bound. The standard errors follow from the observed information at the
    maximum. If a step of the environment has another number of rows of the log than one, then rho
    and sigma are converted: exactly, unless slip is clipped.
    """

    from scipy.optimize import minimize  # here, because its import takes a tenth of a second

    slip, bound, clipped = bounded_slip("ar1", parts, max_slip)
    before, after = transitions(slip)
    bottom = after <= TOLERANCE
    top = (after >= bound - TOLERANCE) & clipped
    inside = ~(bottom | top)
    if inside.sum() < 3 or not np.any(before[inside] > TOLERANCE):
        raise UserError("ar1: nearly all slip in the log is at a bound; record a better log")
    x, y = before[inside], after[inside]
    products = float(x @ x), float(x @ y), float(y @ y)
    low, high = before[bottom], before[top]

    def loss(parameters: np.ndarray) -> float:
        rho, log_sigma = parameters
        sigma = math.exp(log_sigma)
        squares = products[2] - 2.0 * rho * products[1] + rho * rho * products[0]
        total = x.size * (0.5 * math.log(2.0 * math.pi) + log_sigma) + 0.5 * squares / sigma**2
        total -= float(np.sum(log_ndtr(-rho * low / sigma)))
        return total - float(np.sum(log_ndtr((rho * high - bound) / sigma)))

    rho = min(max(products[1] / products[0], 0.0), 1.0)
    sigma = max(float(np.std(y - rho * x)), 1e-6)
    if np.ptp(y - rho * x) <= 1e-9 * bound:
        raise UserError("ar1: the log has no random part, so there is nothing to fit")
    ranges = [(0.0, 1.0), (math.log(1e-7), math.log(10.0))]
    start = np.array([rho, math.log(sigma)])
    found = minimize(loss, start, method="L-BFGS-B", bounds=ranges, options={"ftol": 1e-12})
    rho, log_sigma = (float(number) for number in found.x)
    sigma = math.exp(log_sigma)
    # Steps of about a tenth of a standard error: the change of the loss exceeds its rounding.
    steps = np.array([0.1 * sigma / math.sqrt(products[0]), 0.1 / math.sqrt(2.0 * x.size)])
    curvature = _curvature(loss, found.x, steps)
    notes = []
    converted, slopes = _at_step(rho, sigma, rows_per_step)
    if rho in (0.0, 1.0):
        # The likelihood still rises beyond the bound: only sigma is at a maximum.
        errors = np.array([math.nan, converted[1] / math.sqrt(curvature[1, 1])])
        notes.append(f"rho is at its bound {rho:g}, so it has no standard error.")
    else:
        covariance = slopes @ np.linalg.inv(curvature) @ slopes.T
        errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    share = float(np.mean(~inside))
    if share > 0.0:
        notes.append(
            f"{100 * share:.1f}% of the slip was clipped and contributes a probability: compare "
            "AIC only among fits of ar1, and compare kinds by their error."
        )
    if share > 0.0 and rows_per_step != 1.0:
        notes.append("The conversion to another step is approximate where slip is clipped.")
    expected = _clipped_mean(rho * before, sigma, bound)
    return Fit(
        kind="ar1",
        process=Ar1Slip(rho=converted[0], sigma=converted[1], max_slip=bound),
        estimates={
            "rho": Estimate(converted[0], float(errors[0])),
            "sigma": Estimate(converted[1], float(errors[1])),
            "max_slip": Estimate(bound, math.nan),
        },
        log_likelihood=-float(found.fun),
        parameters=2 + (max_slip is None),
        error=float(np.sqrt(np.mean((after - expected) ** 2))),
        method="maximum likelihood given each first value",
        notes=tuple(notes),
        sequences=tuple(parts),
        process_of_rows=Ar1Slip(rho=rho, sigma=sigma, max_slip=bound),
    )


def _at_step(rho: float, sigma: float, rows: float) -> tuple[tuple[float, float], np.ndarray]:
    """rho and sigma of the process of every ``rows``-th value, if no value is clipped.

    Returns:
        Both, and their derivatives [2, 2] by (rho, log sigma). Those by rho have no meaning if rho
        is 0 or 1.
    """
    if rho in (0.0, 1.0):
        growth = math.sqrt(rows) if rho == 1.0 else 1.0
        return (rho, growth * sigma), np.diag([0.0, growth * sigma])
    decay = rho**rows
    growth = math.sqrt((1.0 - decay**2) / (1.0 - rho**2))
    by_rho = rows * decay / rho
    log_growth = rho / (1.0 - rho**2) - decay * by_rho / (1.0 - decay**2)
    slopes = [[by_rho, 0.0], [growth * sigma * log_growth, growth * sigma]]
    return (decay, growth * sigma), np.array(slopes)


def _curvature(
    loss: Callable[[np.ndarray], float], point: np.ndarray, steps: np.ndarray
) -> np.ndarray:
    """The matrix [2, 2] of second derivatives, by central differences."""
    first, second = np.diag(steps)
    centre = loss(point)
    across = [
        (loss(point + step) - 2.0 * centre + loss(point - step)) / float(step.sum()) ** 2
        for step in (first, second)
    ]
    mixed = (
        loss(point + first + second)
        - loss(point + first - second)
        - loss(point - first + second)
        + loss(point - first - second)
    ) / (4.0 * steps[0] * steps[1])
    return np.array([[across[0], mixed], [mixed, across[1]]])


def _clipped_mean(mean: np.ndarray, deviation: float, top: float) -> np.ndarray:
    """E[clip(N(mean, deviation^2), 0, top)]."""
    a, b = (0.0 - mean) / deviation, (top - mean) / deviation
    inside = ndtr(b) - ndtr(a)
    slope = (np.exp(-0.5 * a**2) - np.exp(-0.5 * b**2)) / math.sqrt(2.0 * math.pi)
    return mean * inside + deviation * slope + top * ndtr(-b)
