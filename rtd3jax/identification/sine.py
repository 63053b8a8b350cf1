"""The rover's slip that goes in waves."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rtd3jax.envs.rover.slip import SineSlip
from rtd3jax.errors import UserError
from rtd3jax.identification.additive import gaussian
from rtd3jax.identification.result import Estimate, Fit
from rtd3jax.identification.slip import bounded_slip

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

SHORTEST = 8
"""Rows with which a wave of three parameters and an offset can be told from noise."""
TRIED = 3
"""Periods from which the least squares start: the best of the profile."""
_FINENESS = 8
"""Periods of the profile for each cycle more that the wave may have."""


def fit_sine(parts: Sequence[np.ndarray], max_slip: float | None = None) -> Fit:
    """`SineSlip`: a wave of its own for every recording and element, and one offset.

    The period is where the squares of a line in sine and cosine are least; from there the clipped
    wave is fitted by nonlinear least squares. The offsets of all waves are averaged with the
    weights of their errors, and the waves are fitted again about it. The process draws amplitudes
    and periods between the least and the greatest found. Its waves have no noise: ``deviation`` is
    what they leave unexplained.
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
        """The mean over the waves; its error includes how much they differ."""
        error = alone if count == 1 else float(values.std(ddof=1)) / math.sqrt(count)
        return Estimate(float(values.mean()), error)

    shortest, longest = max(1, round(periods.min())), max(1, round(periods.max()))
    estimates = {
        "amplitude": average(amplitudes, own[0]),
        "period": average(periods, own[1]),
        "offset": Estimate(offset, 1.0 / math.sqrt(sum(weights))),
        "deviation": Estimate(
            math.sqrt(variance), math.sqrt(variance / (2.0 * max(residual.size - 3 * count, 1)))
        ),
    }
    ends = {
        "amplitude_min": float(amplitudes.min()),
        "amplitude_max": float(amplitudes.max()),
        "period_min": shortest,
        "period_max": longest,
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
    cycles = max(len(wave) / period for wave, period in zip(waves, periods, strict=True))
    if cycles < 1.0:
        notes.append(f"No recording holds a whole period ({cycles:.2f} at most): record longer.")
    process = SineSlip(
        amplitude_min=ends["amplitude_min"],
        amplitude_max=ends["amplitude_max"],
        period_min=shortest,
        period_max=longest,
        offset=offset,
        max_slip=bound,
    )
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
    )


def _wave(parameters: np.ndarray, time: np.ndarray, bound: float) -> np.ndarray:
    """Slip [T] of (sine's part, cosine's part, angle per step, offset)."""
    sine, cosine, angle, offset = parameters
    wave = sine * np.sin(angle * time) + cosine * np.cos(angle * time) + offset
    return np.clip(wave, 0.0, bound)


def _slopes(parameters: np.ndarray, time: np.ndarray, bound: float) -> np.ndarray:
    """Derivatives [T, 4] of `_wave`; zero where it is clipped."""
    sine, cosine, angle, offset = parameters
    up, across = np.sin(angle * time), np.cos(angle * time)
    wave = sine * up + cosine * across + offset
    inside = (wave > 0.0) & (wave < bound)
    columns = (up, across, time * (sine * across - cosine * up), np.ones_like(time))
    return np.stack(columns, axis=1) * inside[:, None]


def _fit_wave(wave: np.ndarray, bound: float) -> "OptimizeResult":
    """The least squares of (sine, cosine, angle, offset), from the best of several periods."""
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
    """The same of (sine, cosine, angle) about a known offset."""
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
    """Limits of a wave of slip. Without limits, half a wave of any height fits a slope."""
    slowest = np.pi / len(time)
    low, high = [-bound, -bound, slowest, -bound], [bound, bound, np.pi, 2.0 * bound]
    return np.array(low), np.array(high)


def _starts(wave: np.ndarray) -> list[np.ndarray]:
    """Parameters at the lowest dips of the profile over the period, from 3 steps to twice all."""
    angles, coefficients, explained = _profile(wave)
    centre = wave.mean()
    sides = np.concatenate([[-np.inf], explained, [-np.inf]])
    peaks = np.flatnonzero((explained >= sides[:-2]) & (explained >= sides[2:]))
    # A dip that is half as deep as the lowest is the window's, or another wave's.
    peaks = peaks[explained[peaks] >= 0.5 * explained.max()]
    best = peaks[np.argsort(-explained[peaks])][:TRIED]
    return [np.array([*coefficients[p][:2], angles[p], coefficients[p][2] + centre]) for p in best]


def _profile(wave: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The line in sine and cosine that explains most of a ``wave`` [T], for each of P periods.

    The periods lie an eighth of a cycle apart, so that all sums over the rows stand in a Fourier
    transform of the wave, padded to eight times its length: memory grows with T, not with P T.

    Returns:
        angle per step [P]; coefficients [P, 3] of sine, cosine and one, about the wave's mean; how
        much of the sum of squares each explains [P].
    """
    count = len(wave)
    bins = np.arange(4, math.ceil(_FINENESS * count / 3.0))
    sums = np.fft.fft(wave - wave.mean(), _FINENESS * count)
    ones = np.fft.fft(np.ones(count), _FINENESS * count)
    # The transform turns the other way: its imaginary part is minus the sum of sines.
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
    """The variance of the residuals; each wave takes ``parameters`` degrees of freedom."""
    freedom = sum(len(part) - parameters for part in residuals)
    return max(sum(float(part @ part) for part in residuals) / freedom, 1e-16)


def _covariance(slopes: np.ndarray, variance: float) -> np.ndarray:
    """The covariance of the estimates of least squares."""
    # A wave that is clipped throughout says nothing: it has no weight, rather than all of it.
    return variance * np.linalg.inv(slopes.T @ slopes + 1e-12 * np.eye(slopes.shape[1]))
