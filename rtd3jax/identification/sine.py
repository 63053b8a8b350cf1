"""Fits the rover's sinusoidal slip."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rtd3jax.envs.rover.slip import SineSlip
from rtd3jax.errors import UserError
from rtd3jax.identification.additive import gaussian
from rtd3jax.identification.result import Estimate, Fit
from rtd3jax.identification.slip import bounded_slip

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

SHORTEST = 8
"""Fewest rows of a wave that is fitted: a wave has three parameters and an offset."""
TRIED = 3
"""Number of initial periods for the least squares: the best ones of the profile."""
WIDEST = 4.0
"""Largest factors of sine and cosine, and offset, that are tried, in units of ``max_slip``."""
_FINENESS = 8
"""Number of periods in the profile from k to k + 1 cycles in a recording."""


def fit_sine(
    parts: Sequence[np.ndarray], max_slip: float | None = None, rows_per_step: float = 1.0
) -> Fit:
    """Fit `SineSlip`: a separate wave for each element of each recording, and one offset for all.

    A linear regression on sine and cosine, for each period of a grid, gives the initial period of a
    wave. Then nonlinear least squares fit the clipped wave. The offset of the process is the mean
    of all waves' offsets, weighted by their inverse variances, and the waves are fitted again with
    this offset. The process draws amplitudes and periods between the smallest and the largest of
    the log. Its waves have no noise; the estimate ``deviation`` is the standard deviation of the
    residuals. Periods are in steps of the environment, of which each has ``rows_per_step`` rows of
    the log.

    Raises:
        UserError: when the log is not slip, or no recording is long enough.
    """
    slip, bound, _ = bounded_slip("sine", parts, max_slip)
    every = [part[:, k] for part in slip for k in range(part.shape[1])]
    waves = [wave for wave in every if len(wave) >= SHORTEST and np.ptp(wave) > 0.0]
    if not waves:
        raise UserError(
            f"sine: no recording has {SHORTEST} rows of slip that changes; record longer stretches"
        )
    free = [_fit_wave(wave, bound) for wave in waves]
    variance = _variance([fit.fun for fit in free], 4)
    weights = [1.0 / _covariance(fit.jac, variance)[3, 3] for fit in free]
    offset = float(np.average([fit.x[3] for fit in free], weights=weights))
    fits = [_refit(wave, bound, fit.x, offset) for wave, fit in zip(waves, free, strict=True)]
    residual = np.concatenate([fit.fun for fit in fits])
    variance = max(_variance([fit.fun for fit in fits], 3), 1e-16)
    amplitudes = np.array([math.hypot(fit.x[0], fit.x[1]) for fit in fits])
    periods = np.array([2.0 * math.pi / fit.x[2] for fit in fits])
    first = fits[0]
    covariance = _covariance(first.jac, variance)
    slope = np.array([first.x[0], first.x[1], 0.0]) / amplitudes[0]
    own = (
        math.sqrt(slope @ covariance @ slope),
        math.sqrt(covariance[2, 2]) * 2.0 * math.pi / first.x[2] ** 2,
    )
    count = len(fits)

    def average(values: np.ndarray, alone: float) -> Estimate:
        """The mean over the waves; its standard error includes the differences of the waves."""
        error = alone if count == 1 else float(values.std(ddof=1)) / math.sqrt(count)
        return Estimate(float(values.mean()), error)

    def ends_of_period(rows: float) -> dict[str, int]:
        """The ends of the range of periods in steps of so many rows, as whole numbers."""
        shortest, longest = (max(1, round(end / rows)) for end in (periods.min(), periods.max()))
        return {"period_min": shortest, "period_max": longest}

    estimates = {
        "amplitude": average(amplitudes, own[0]),
        "period": average(periods / rows_per_step, own[1] / rows_per_step),
        "offset": Estimate(offset, 1.0 / math.sqrt(sum(weights))),
        "deviation": Estimate(
            math.sqrt(variance), math.sqrt(variance / (2.0 * max(residual.size - 3 * count, 1)))
        ),
    }
    ends: dict[str, Any] = {
        "amplitude_min": float(amplitudes.min()),
        "amplitude_max": float(amplitudes.max()),
        **ends_of_period(rows_per_step),
        "max_slip": bound,
    }
    estimates |= {name: Estimate(float(value), math.nan) for name, value in ends.items()}
    notes = ["Amplitudes and periods are drawn between the least and the greatest of the log."]
    if len(waves) < len(every):
        left = 1.0 - sum(map(len, waves)) / sum(map(len, every))
        notes.append(
            f"{len(every) - len(waves)} of {len(every)} recordings of an element are shorter than "
            f"{SHORTEST} rows or do not change, {100 * left:.0f}% of the values: they were left "
            "out, so neither AIC nor the error can be compared with other kinds."
        )
    limited = sum(
        bool(np.any(np.abs([*one.x[[0, 1, 3]], *other.x[:2]]) > 0.99 * WIDEST * bound))
        for one, other in zip(free, fits, strict=True)
    )
    if limited:
        notes.append(
            f"{limited} of {len(fits)} waves have the largest amplitude or offset that is tried, "
            f"{WIDEST:g} times max_slip: they are clipped too much to tell their amplitude."
        )
    cycles = max(len(wave) / period for wave, period in zip(waves, periods, strict=True))
    if cycles < 1.0:
        notes.append(f"No recording holds a whole period ({cycles:.2f} at most): record longer.")
    if periods.min() < 2.0 * rows_per_step:
        notes.append("The shortest waves have less than two steps in a period: they are aliased.")
    process = SineSlip(**ends, offset=offset)
    # As in the other fits, only values with a previous value count, so that AIC is comparable.
    later = np.concatenate([fit.fun[1:] for fit in fits])
    mean_square = max(float(np.mean(later**2)), 1e-16)
    return Fit(
        kind="sine",
        process=process,
        estimates=estimates,
        log_likelihood=gaussian(later, mean_square),
        parameters=3 * count + 2,
        error=math.sqrt(mean_square),
        method="least squares of each wave, the period by its profile",
        notes=tuple(notes),
        sequences=tuple(parts),
        process_of_rows=process.replace(**ends_of_period(1.0)),
    )


def _wave(parameters: np.ndarray, time: np.ndarray, bound: float) -> np.ndarray:
    """Slip [T] for (factor of the sine, factor of the cosine, angle per step, offset)."""
    sine, cosine, angle, offset = parameters
    wave = sine * np.sin(angle * time) + cosine * np.cos(angle * time) + offset
    return np.clip(wave, 0.0, bound)


def _slopes(parameters: np.ndarray, time: np.ndarray, bound: float) -> np.ndarray:
    """Derivatives [T, 4] of `_wave` by its parameters; zero where the wave is clipped."""
    sine, cosine, angle, offset = parameters
    up, across = np.sin(angle * time), np.cos(angle * time)
    wave = sine * up + cosine * across + offset
    inside = (wave > 0.0) & (wave < bound)
    columns = (up, across, time * (sine * across - cosine * up), np.ones_like(time))
    return np.stack(columns, axis=1) * inside[:, None]


def _fit_wave(wave: np.ndarray, bound: float) -> "OptimizeResult":
    """The least-squares fit of (sine, cosine, angle, offset): the best one of several starts."""
    from scipy.optimize import least_squares

    time = np.arange(len(wave), dtype=np.float64)
    found = [
        least_squares(
            lambda p: _wave(p, time, bound) - wave,
            np.clip(start, *_limits(time, bound)),
            jac=lambda p: _slopes(p, time, bound),
            bounds=_limits(time, bound),
            x_scale=[bound, bound, 1.0 / len(wave), bound],
            max_nfev=60,
        )
        for start in _starts(wave)
    ]
    return min(found, key=lambda fit: fit.cost)


def _refit(wave: np.ndarray, bound: float, start: np.ndarray, offset: float) -> "OptimizeResult":
    """As `_fit_wave`, of (sine, cosine, angle) for a known ``offset``, from one ``start``."""
    from scipy.optimize import least_squares

    time = np.arange(len(wave), dtype=np.float64)
    return least_squares(
        lambda p: _wave(np.append(p, offset), time, bound) - wave,
        start[:3],
        jac=lambda p: _slopes(np.append(p, offset), time, bound)[:, :3],
        bounds=tuple(limit[:3] for limit in _limits(time, bound)),
        x_scale=[bound, bound, 1.0 / len(wave)],
        max_nfev=60,
    )


def _limits(time: np.ndarray, bound: float) -> tuple[np.ndarray, np.ndarray]:
    """Limits of a wave's parameters. Without them, half a wave of any amplitude fits a line."""
    slowest, most = np.pi / len(time), WIDEST * bound
    return np.array([-most, -most, slowest, -most]), np.array([most, most, np.pi, most])


def _starts(wave: np.ndarray) -> list[np.ndarray]:
    """The parameters at the best periods of the profile, at most ``TRIED``."""
    angles, coefficients, explained = _profile(wave)
    centre = wave.mean()
    sides = np.concatenate([[-np.inf], explained, [-np.inf]])
    peaks = np.flatnonzero((explained >= sides[:-2]) & (explained >= sides[2:]))
    # A peak below half of the highest one is a side lobe, or belongs to another wave.
    peaks = peaks[explained[peaks] >= 0.5 * explained.max()]
    best = peaks[np.argsort(-explained[peaks])][:TRIED]
    return [np.array([*coefficients[p][:2], angles[p], coefficients[p][2] + centre]) for p in best]


def _profile(wave: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The regressions of ``wave`` [T] on sine and cosine, for P periods from 3 steps to 2 T.

    The periods lie an eighth of a cycle apart. So all sums over the rows are elements of a Fourier
    transform of the wave, padded to eight times its length, and memory grows with T, not with P T.

    Returns:
        The angle per step [P]; the coefficients [P, 3] of sine, cosine and one, for the wave minus
        its mean; the part of the sum of squares that each regression explains [P].
    """
    count = len(wave)
    bins = np.arange(4, math.ceil(_FINENESS * count / 3.0))
    sums = np.fft.fft(wave - wave.mean(), _FINENESS * count)
    ones = np.fft.fft(np.ones(count), _FINENESS * count)
    # The transform has the factor exp(-i angle t): its imaginary part is minus the sum of sines.
    right = np.stack([-sums[bins].imag, sums[bins].real, np.full(len(bins), sums[0].real)], axis=1)
    sine, cosine, twice = -ones[bins].imag, ones[bins].real, ones[2 * bins]
    both = -0.5 * twice.imag
    rows = [
        (0.5 * (count - twice.real), both, sine),
        (both, 0.5 * (count + twice.real), cosine),
        (sine, cosine, np.full(len(bins), float(count))),
    ]
    normal = np.stack([np.stack(row, axis=-1) for row in rows], axis=1) + 1e-9 * np.eye(3)
    coefficients = np.linalg.solve(normal, right[..., None])[..., 0]
    angles = 2.0 * np.pi * bins / (_FINENESS * count)
    return angles, coefficients, np.sum(coefficients * right, axis=1)


def _variance(residuals: Sequence[np.ndarray], parameters: int) -> float:
    """The variance of the residuals; each wave uses ``parameters`` degrees of freedom."""
    freedom = sum(len(part) - parameters for part in residuals)
    return max(sum(float(part @ part) for part in residuals) / freedom, 1e-16)


def _covariance(slopes: np.ndarray, variance: float) -> np.ndarray:
    """The covariance matrix of least-squares estimates, from their derivatives ``slopes``."""
    # The added term gives a wave that is clipped everywhere a large variance, so no weight.
    return variance * np.linalg.inv(slopes.T @ slopes + 1e-12 * np.eye(slopes.shape[1]))
