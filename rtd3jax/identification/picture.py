"""Plots of a fit: recorded and simulated sequences."""

import io
import os
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.envs.processes.process import Process
from rtd3jax.envs.rover.slip import WHEELS, Ar1Slip, SineSlip
from rtd3jax.errors import UserError, short_reason
from rtd3jax.evaluation.style import STYLE
from rtd3jax.system.files import check_target, write_new

RECORDED, FITTED = "#222222", "#D55E00"
MOST_EPISODES = 200
MOST_ROWS = 1_000
"""Steps of an episode of the fitted process, and of a sequence for the spectrum, at most."""


def played(process: Process, steps: int, size: int, episodes: int, seed: int) -> np.ndarray:
    """Simulated offsets [episodes, steps, size] of a process, or slips [episodes, steps, 2]."""
    if getattr(process, "elements", ()):  # the log has a column for each disturbed element only
        process = process.replace(elements=())
    if isinstance(process, Ar1Slip | SineSlip):
        size = WHEELS  # for a log of any size: all its elements have the same distribution
    ones = jnp.ones((size,), jnp.float32)
    still = jnp.zeros((size,), jnp.float32)

    def episode(key: jax.Array) -> jax.Array:
        first, rest = jax.random.split(key)

        def step(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            # For the input 0, the output of a slip process is 0; for the input 1, it is 1 - slip.
            none, _ = process.step(key, state, still)
            one, state = process.step(key, state, ones)
            return state, jnp.where(none == 0.0, 1.0 - one, none)

        state = process.init(first, steps, size)
        return jax.lax.scan(step, state, jax.random.split(rest, steps))[1]

    keys = jax.random.split(jax.random.key(seed), episodes)
    return np.asarray(jax.jit(jax.vmap(episode))(keys), np.float64)


def draw_fit(
    kind: str,
    process: Process,
    sequences: Sequence[np.ndarray],
    path: str | os.PathLike,
    overwrite: bool,
    seed: int,
    unit: str = "step",
) -> None:
    """Write the plot of a process and the sequences [T, N]; see `Fit.plot`.

    ``unit`` is the name of the time between two rows.
    """
    target = check_target(path, overwrite)
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    recorded = [wave for part in sequences for wave in part.T]
    steps = min(max(map(len, recorded)), MOST_ROWS)
    size = sequences[0].shape[1]
    episodes = min(max(len(sequences), 20), MOST_EPISODES)
    fitted = [wave for part in played(process, steps, size, episodes, seed) for wave in part.T]
    settings: Any = {**STYLE, "legend.fontsize": 8.0}
    with rc_context(settings):
        figure = Figure(figsize=(9.6, 3.0), dpi=120, layout="constrained")
        axes = figure.subplots(1, 3)
        _draw_distribution(axes[0], recorded, fitted)
        _draw_autocorrelation(axes[1], recorded, fitted)
        axes[1].set_xlabel(f"lag in {unit}s")
        _draw_spectrum(axes[2], recorded, fitted)
        axes[2].set_xlabel(f"cycles per {unit}")
        axes[0].legend()
        figure.suptitle(
            f"{kind}: {len(sequences)} recordings of {size} elements, and "
            f"{episodes} episodes of the fitted process",
            fontsize=10,
        )
        buffer = io.BytesIO()
        try:
            figure.savefig(buffer, format=target.suffix.lstrip(".").lower() or "png")
        except ValueError as error:
            raise UserError(
                f"{path}: {short_reason(error)}; use a name that ends in .png, .svg or .pdf"
            ) from error
    write_new(path, buffer.getvalue(), overwrite)


def _draw_distribution(axis: Any, recorded: Sequence[np.ndarray], fitted: Sequence[np.ndarray]):
    every, model = np.concatenate(recorded), np.concatenate(fitted)
    edges = np.linspace(min(every.min(), model.min()), max(every.max(), model.max()), 41)
    axis.hist(every, edges, density=True, color=RECORDED, alpha=0.25, label="recorded")
    axis.hist(model, edges, density=True, histtype="step", color=FITTED, lw=1.4, label="fitted")
    axis.set(xlabel="value", ylabel="density", title="distribution")


def _draw_autocorrelation(axis: Any, recorded: Sequence[np.ndarray], fitted: Sequence[np.ndarray]):
    lags = max(2, min(100, max(map(len, recorded)) // 2))
    for waves, colour, width in ((recorded, RECORDED, 2.2), (fitted, FITTED, 1.4)):
        axis.plot(autocorrelation(waves, lags), color=colour, lw=width)
    axis.axhline(0.0, color="#999999", linewidth=0.8)
    axis.set(ylabel="correlation", title="autocorrelation")


def autocorrelation(waves: Sequence[np.ndarray], lags: int) -> np.ndarray:
    """The pooled autocorrelation around the common mean, [lags]; NaN at lags without data."""
    mean = np.concatenate(waves).mean()
    products, counts = np.zeros(lags), np.zeros(lags)
    for wave in waves:
        centred = wave - mean
        for lag in range(min(lags, len(wave))):
            products[lag] += centred[lag:] @ centred[: len(wave) - lag]
            counts[lag] += len(wave) - lag
    with np.errstate(invalid="ignore", divide="ignore"):
        covariance = products / counts
        return covariance / covariance[0]


def _draw_spectrum(axis: Any, recorded: Sequence[np.ndarray], fitted: Sequence[np.ndarray]):
    rows = min(int(np.median([len(wave) for wave in recorded])), MOST_ROWS)
    rows = max(4, min(rows, len(fitted[0])))
    for waves, colour, width in ((recorded, RECORDED, 2.2), (fitted, FITTED, 1.4)):
        power = spectrum(waves, rows)
        if power is not None:
            axis.loglog(np.fft.rfftfreq(rows)[1:], power[1:], color=colour, lw=width)
    axis.set(ylabel="power per frequency", title="spectrum")


def spectrum(waves: Sequence[np.ndarray], rows: int) -> np.ndarray | None:
    """The mean one-sided periodogram of all parts of ``rows`` rows, with a Hann window."""
    mean = np.concatenate(waves).mean()
    pieces = [
        wave[start : start + rows] - mean
        for wave in waves
        for start in range(0, len(wave) - rows + 1, rows)
    ]
    if not pieces:
        return None
    window = np.hanning(rows + 2)[1:-1]
    power = np.abs(np.fft.rfft(np.stack(pieces) * window, axis=1)) ** 2
    return 2.0 * power.mean(axis=0) / np.sum(window**2)
