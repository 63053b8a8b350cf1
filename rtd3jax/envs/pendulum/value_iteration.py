"""The pendulum's best possible return, by value iteration over a grid of its states.

The horizon is finite (200 steps), and the dynamics are known and deterministic. So backward
induction gives the optimal value of every state, except for the interpolation error of the grid
(Bellman, 1957). This error is proportional to the spacing of the grid. Two grids therefore allow
Richardson's extrapolation, and a third grid estimates the error of the extrapolation.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from rtd3jax.envs.pendulum.environment import PendulumParams

ANGLES, SPEEDS, TORQUES = 400, 320, 41
"""Grid intervals of the angle (a full turn) and of the speed; number of torques."""

START_SPEED = 1.0
"""gymnax draws theta from U(-pi, pi) and theta dot from U(-1, 1) at the start of an episode."""


@functools.lru_cache(maxsize=8)
def optimal_value(
    params: PendulumParams, angles: int = ANGLES, speeds: int = SPEEDS
) -> tuple[np.ndarray, float]:
    """The optimal return of each state at the start of an episode.

    Args:
        params: the pendulum's parameters, as Python numbers, because they are hashed.
        angles: grid intervals over a full turn, from -pi; the angle is periodic.
        speeds: grid intervals over the speed's range.

    Returns:
        Values float32 [angles, speeds + 1], and the top speed.
    """
    horizon = int(params.max_steps_in_episode)
    improve, start, top = _backup(params, angles, speeds)
    solve = jax.jit(lambda value: lax.fori_loop(0, horizon, lambda _, v: improve(v), value))
    return np.asarray(solve(start)), top


@functools.lru_cache(maxsize=2)
def optimal_values(
    params: PendulumParams, angles: int, speeds: int, steps: int, kick: float = 0.0
) -> tuple[np.ndarray, float]:
    """The optimal return of each state with 0, 1, ..., ``steps`` - 1 remaining steps.

    Args:
        params: as in `optimal_value`.
        angles: as in `optimal_value`.
        speeds: as in `optimal_value`.
        steps: number of value functions.
        kick: standard deviation, rad, of a normal disturbance after every step. It moves the state,
            angle and speed together, along the unstable direction of the upright pendulum.

    Returns:
        Values float32 [steps, angles, speeds + 1] of states before the kick, and the top speed.
    """
    improve, start, top = _backup(params, angles, speeds)

    def step(value, _):
        kicked = _kicked(value, params, kick, top) if kick else value
        return improve(kicked), kicked

    solve = jax.jit(lambda value: lax.scan(step, value, length=steps)[1])
    return np.asarray(solve(start)), top


def _kicked(value: jax.Array, params: PendulumParams, kick: float, top: float) -> jax.Array:
    """Mean of ``value`` after the kick, by the three-point Gauss-Hermite rule."""
    angles, points = value.shape
    angle = -math.pi + 2 * math.pi * jnp.arange(angles, dtype=jnp.float32) / angles
    speed = jnp.linspace(-top, top, points, dtype=jnp.float32)
    growth = math.sqrt(1.5 * params.g / params.l)  # per second, near upright

    def moved(deviations: float) -> jax.Array:
        far = jnp.clip(speed + deviations * kick * growth, -top, top)
        return interpolate(value, (angle + deviations * kick)[:, None], far[None, :], top)

    return moved(0.0) * (2 / 3) + (moved(math.sqrt(3)) + moved(-math.sqrt(3))) / 6


def _backup(params: PendulumParams, angles: int, speeds: int):
    """The Bellman backup on the grid, the value without remaining steps, and the top speed."""
    top = float(params.max_speed)
    angle = -math.pi + 2 * math.pi * jnp.arange(angles, dtype=jnp.float32) / angles
    speed = jnp.linspace(-top, top, speeds + 1, dtype=jnp.float32)
    torques = torques_to_try(float(params.max_torque))

    def improve(value: jax.Array) -> jax.Array:
        def of_torque(torque):
            after, speed_after, reward = swing(params, angle[:, None], speed[None, :], torque)
            return reward + interpolate(value, after, speed_after, top)

        return lax.map(of_torque, torques).max(axis=0)

    return improve, jnp.zeros((angles, speeds + 1), jnp.float32), top


def torques_to_try(limit: float | jax.Array) -> jax.Array:
    """Evenly spaced torques [TORQUES] within the limit."""
    return jnp.linspace(-1.0, 1.0, TORQUES, dtype=jnp.float32) * limit


def mean_optimal_return(
    params: PendulumParams, angles: int = ANGLES, speeds: int = SPEEDS
) -> tuple[float, float]:
    """The optimal return's mean over the distribution of starts, and its error.

    The mean is an integral, without sampling error. It is extrapolated from a grid and a grid of
    twice the spacing. The error is the difference to the extrapolation from twice and four times
    the spacing. ``angles`` and ``speeds`` must therefore be divisible by four.
    """

    def on_grid(coarser: int) -> float:
        value, top = optimal_value(params, angles // coarser, speeds // coarser)
        return mean_over_starts(value, top)

    fine, middle, coarse = (on_grid(coarser) for coarser in (1, 2, 4))
    mean, before = 2 * fine - middle, 2 * middle - coarse
    return mean, abs(mean - before)


def mean_over_starts(value: np.ndarray, top: float) -> float:
    """Mean of the interpolated ``value`` over the starts of episodes.

    Between grid points, the interpolation is linear along each axis. So the mean over the periodic
    angle is the mean over its grid points, and the trapezium rule is exact for the speed if its
    nodes contain the nodes of the grid.
    """
    profile = value.mean(axis=0, dtype=np.float64)
    grid = np.linspace(-top, top, profile.size)
    low, high = max(-START_SPEED, -top), min(START_SPEED, top)
    nodes = np.concatenate(([low], grid[(grid > low) & (grid < high)], [high]))
    return float(np.trapezoid(np.interp(nodes, grid, profile), nodes) / (high - low))


def interpolate(value: jax.Array, angle: jax.Array, speed: jax.Array, top: float) -> jax.Array:
    """``value`` [angles, speeds + 1], interpolated bilinearly; periodic in the angle."""
    angles, points = value.shape
    row = (angle + math.pi) * (angles / (2 * math.pi))
    column = (speed + top) * ((points - 1) / (2 * top))
    lower = jnp.floor(row)
    left = jnp.clip(jnp.floor(column), 0, points - 2)
    a, b = row - lower, column - left
    i = lower.astype(jnp.int32) % angles
    k, j = (i + 1) % angles, left.astype(jnp.int32)
    below = (1 - b) * value[i, j] + b * value[i, j + 1]
    above = (1 - b) * value[k, j] + b * value[k, j + 1]
    return (1 - a) * below + a * above


def swing(
    params: PendulumParams, angle: jax.Array, speed: jax.Array, torque: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """gymnax's pendulum for arrays of states: the next angle, the next speed, and the reward."""
    g, mass, length, dt = params.g, params.m, params.l, params.dt
    folded = (angle + math.pi) % (2 * math.pi) - math.pi
    reward = -(folded**2 + 0.1 * speed**2 + 0.001 * torque**2)
    force = 1.5 * g / length * jnp.sin(angle) + 3.0 / (mass * length**2) * torque
    after = jnp.clip(speed + force * dt, -params.max_speed, params.max_speed)
    return angle + after * dt, after, reward
