"""The pendulum's best possible return, by value iteration over a grid of its states.

The horizon is finite (200 steps) and the dynamics are known and deterministic, so that backward
induction gives the optimal value of every state up to the error of interpolating on the grid
(Bellman, 1957). That error falls in proportion to the grid's spacing, so that two grids tell where
it is going (Richardson's extrapolation); tests/test_value_iteration.py halves the spacing.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from rtd3jax.envs.pendulum import PendulumParams

ANGLES, SPEEDS, TORQUES = 400, 320, 41
"""Grid intervals of the angle (a full turn) and the speed; torques that are tried."""


@functools.lru_cache(maxsize=8)
def optimal_value(
    params: PendulumParams, angles: int = ANGLES, speeds: int = SPEEDS
) -> tuple[np.ndarray, float]:
    """The optimal return of each state at an episode's start.

    Args:
        params: of the pendulum; its numbers must be plain.
        angles: grid intervals over a full turn, from -pi; the angle is periodic.
        speeds: grid intervals over the speed's range.

    Returns:
        Values float32 [angles, speeds + 1], and the top speed.
    """
    top = float(params.max_speed)
    angle = -math.pi + 2 * math.pi * jnp.arange(angles, dtype=jnp.float32) / angles
    speed = jnp.linspace(-top, top, speeds + 1, dtype=jnp.float32)
    torques = jnp.linspace(-1.0, 1.0, TORQUES, dtype=jnp.float32) * float(params.max_torque)

    def improve(_, value):
        def of_torque(torque):
            after, speed_after, reward = _step(params, angle[:, None], speed[None, :], torque)
            return reward + interpolate(value, after, speed_after, top)

        return lax.map(of_torque, torques).max(axis=0)

    horizon = int(params.max_steps_in_episode)
    solve = jax.jit(lambda start: lax.fori_loop(0, horizon, improve, start))
    return np.asarray(solve(jnp.zeros((angles, speeds + 1), jnp.float32))), top


def mean_optimal_return(
    params: PendulumParams, starts: int, seed: int, angles: int = ANGLES, speeds: int = SPEEDS
) -> tuple[float, float]:
    """Mean optimal return over random starts, and the standard error of that mean."""
    random = np.random.default_rng(seed)
    angle = jnp.asarray(random.uniform(-math.pi, math.pi, starts), jnp.float32)
    speed = jnp.asarray(random.uniform(-1.0, 1.0, starts), jnp.float32)

    def on_grid(angles: int, speeds: int) -> np.ndarray:
        value, top = optimal_value(params, angles, speeds)
        return np.asarray(interpolate(jnp.asarray(value), angle, speed, top), np.float64)

    values = 2 * on_grid(angles, speeds) - on_grid(angles // 2, speeds // 2)
    return float(values.mean()), float(values.std(ddof=1) / math.sqrt(starts))


def interpolate(value: jax.Array, angle: jax.Array, speed: jax.Array, top: float) -> jax.Array:
    """``value`` [angles, speeds + 1] between its grid points, bilinearly; periodic in the angle."""
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


def _step(params: PendulumParams, angle: jax.Array, speed: jax.Array, torque: jax.Array):
    """gymnax's pendulum, over arrays of states: the next angle, the next speed, the reward."""
    g, mass, length, dt = (float(getattr(params, name)) for name in ("g", "m", "l", "dt"))
    folded = (angle + math.pi) % (2 * math.pi) - math.pi
    reward = -(folded**2 + 0.1 * speed**2 + 0.001 * torque**2)
    force = 1.5 * g / length * jnp.sin(angle) + 3.0 / (mass * length**2) * torque
    top = float(params.max_speed)
    after = jnp.clip(speed + force * dt, -top, top)
    return angle + after * dt, after, reward
