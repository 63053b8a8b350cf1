"""The rover's optimal policy, whose mean return no agent can exceed.

The slip does not depend on the actions, and the motion has no inertia, so the optimal policy is
myopic. The last action and the observation determine the last slip exactly. The optimal command
minimises, within its bounds, the expected squared error, which the conditional moments of the next
slip determine.
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.scipy.stats import norm

from rtd3jax.envs.description import Ceiling
from rtd3jax.envs.processes.process import NoDisturbance, Process, float32
from rtd3jax.envs.rover.environment import Rover, RoverParams
from rtd3jax.envs.rover.slip import WHEELS, Ar1Slip, SineSlip
from rtd3jax.envs.rover.task import limits, sides
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.system.jax_settings import random_key
from rtd3jax.system.numbers import standard_error


class BayesState(NamedTuple):
    """The state of the Bayes policy.

    Attributes:
        nominal: float32 [2], the last commanded wheel speeds, m/s.
        slip: float32 [2], the last inferred slip.
        time: int32 [], number of steps so far.
    """

    nominal: jax.Array
    slip: jax.Array
    time: jax.Array


@struct.dataclass
class BayesPolicy:
    """The rover's optimal policy if its slip follows ``model``; see `bayes_policy`."""

    params: RoverParams
    model: Process

    def init(self, key: jax.Array | None = None) -> BayesState:
        """The state before the first step of an episode; ``key`` is not used."""
        zeros = jnp.zeros((2,), jnp.float32)
        return BayesState(zeros, zeros, jnp.int32(0))

    def step(self, state: BayesState, observation: jax.Array) -> tuple[jax.Array, BayesState]:
        """The command [2] with the least expected squared error."""
        params = self.params
        slip = _inferred_slip(params, state, observation)
        first, second = _traction_moments(self.model, slip, state.time == 0)
        action = best_command(params, first, second)
        nominal = sides(action[0], action[1], float32(params.wheelbase))
        return action, BayesState(nominal, slip, state.time + jnp.int32(1))


def bayes_policy(env: EnvironmentLike, model: Process | None = None) -> BayesPolicy:
    """The optimal policy of a rover whose slip follows ``model``.

    Args:
        env: a rover.
        model: the slip process that the policy assumes; the environment's process by default. The
            policy can also be evaluated under another process, to test its robustness.

    Raises:
        UserError: when ``env`` is not a rover, or the model's moments are not known.
    """
    if not isinstance(env, Rover):
        raise UserError("bayes_policy is only known for the rover")
    params = env.default_params
    model = params.slip if model is None else model
    if not isinstance(model, Ar1Slip | NoDisturbance):
        raise UserError(
            f"the conditional moments of {type(model).__name__} are not known; "
            "pass an Ar1Slip as the model"
        )
    return BayesPolicy(params, model)


def best_return(env: EnvironmentLike, episodes: int, seed: int) -> Ceiling | BayesPolicy:
    """The optimal policy of a rover, whose return is the ceiling; an upper bound for sine slip.

    Args:
        env: a rover.
        episodes: number of episodes over which the bound is averaged.
        seed: seed of these episodes.

    Raises:
        UserError: for a rover with faults, or a slip whose moments are not known.
    """
    if not isinstance(env, Rover):
        raise UserError("the rover's ceiling is only known without disturbances other than slip")
    if isinstance(env.default_params.slip, SineSlip):
        return _sine_bound(env.default_params, episodes, seed)
    return bayes_policy(env)


def _sine_bound(params: RoverParams, episodes: int, seed: int) -> Ceiling:
    """An upper bound for sine slip: the errors are assumed zero from the second step on.

    At the first step nothing has been observed, so no policy is better at this step than the best
    constant command under the prior.
    """
    keys = jax.random.split(random_key(seed), episodes)
    horizon = params.max_steps_in_episode
    slip = jax.vmap(lambda key: params.slip.init(key, horizon, WHEELS).slip)(keys)
    traction = 1.0 - slip
    command = best_command(params, traction.mean(0), (traction**2).mean(0))
    realised = traction * sides(command[0], command[1], float32(params.wheelbase))[None, :]
    speed = realised.mean(axis=1)
    yaw_rate = (realised[:, 1] - realised[:, 0]) / params.wheelbase
    losses = (speed - params.target_speed) ** 2 + (yaw_rate - params.target_yaw_rate) ** 2
    returns = -np.asarray(losses, np.float64)
    return Ceiling(float(returns.mean()), standard_error(returns), "upper bound")


def _inferred_slip(params: RoverParams, state: BayesState, observation: jax.Array) -> jax.Array:
    """The slip [2] of the last step, from the last command and the observed motion."""
    speed = observation[0] + params.target_speed
    turn = 0.5 * params.wheelbase * (observation[1] + params.target_yaw_rate)
    realised = jnp.stack((speed - turn, speed + turn))
    moved = jnp.abs(state.nominal) > 1e-6
    ratio = realised / jnp.where(moved, state.nominal, 1.0)
    return jnp.where(moved, jnp.clip(1.0 - ratio, 0.0, 1.0), state.slip)


def _traction_moments(
    model: Process, slip: jax.Array, first_step: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """E[1 - s] and E[(1 - s)^2] of the slip of the next step, per wheel: [2] each."""
    if isinstance(model, NoDisturbance):
        ones = jnp.ones((2,), jnp.float32)
        return ones, ones
    assert isinstance(model, Ar1Slip)
    # s_0 ~ U(0, m); afterwards s' = clip(N(rho s, sigma^2), 0, m).
    m = jnp.float32(model.max_slip)
    mean, square = clipped_normal_moments(model.rho * slip, jnp.float32(model.sigma), m)
    mean = jnp.where(first_step, 0.5 * m, mean)
    square = jnp.where(first_step, m * m / 3.0, square)
    return 1.0 - mean, 1.0 - 2.0 * mean + square


def clipped_normal_moments(
    mean: jax.Array, deviation: jax.Array, top: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """E[y] and E[y^2] of ``y = clip(N(mean, deviation^2), 0, top)``, with deviation >= 0."""
    certain = jnp.clip(mean, 0.0, top)
    random = deviation > 0.0
    deviation = jnp.where(random, deviation, 1.0)
    a, b = (0.0 - mean) / deviation, (top - mean) / deviation
    inside = norm.cdf(b) - norm.cdf(a)
    slope = norm.pdf(a) - norm.pdf(b)
    above = norm.sf(b)
    first = mean * inside + deviation * slope + top * above
    curve = a * norm.pdf(a) - b * norm.pdf(b)
    second = (
        (mean**2 + deviation**2) * inside
        + 2.0 * mean * deviation * slope
        + deviation**2 * curve
        + top**2 * above
    )
    return jnp.where(random, first, certain), jnp.where(random, second, certain**2)


def best_command(params: RoverParams, first: jax.Array, second: jax.Array) -> jax.Array:
    """The command [2] within its bounds with the least expected squared error of the motion.

    With tractions x and wheel speeds u the motion is v = (x_L u_L + x_R u_R)/2 and
    omega = (x_R u_R - x_L u_L)/b; the wheels slip independently, so the expectation is a convex
    quadratic of the command. Its minimum in the rectangle of commands is the free minimum, or on
    one of the four edges.

    Args:
        params: the rover.
        first: E[x], [2].
        second: E[x^2], [2].
    """
    base = float32(params.wheelbase)
    sum_weight, difference_weight = 0.25, 1.0 / base**2
    cross = (sum_weight - difference_weight) * first[0] * first[1]
    diagonal = (sum_weight + difference_weight) * second
    matrix = jnp.stack((jnp.stack((diagonal[0], cross)), jnp.stack((cross, diagonal[1]))))
    turn = params.target_yaw_rate / base
    right = first * jnp.stack((0.5 * params.target_speed - turn, 0.5 * params.target_speed + turn))
    # The same quadratic, c'Ac - 2 g'c, of the command c = (speed, yaw rate).
    to_wheels = jnp.stack(
        (jnp.stack((jnp.float32(1.0), -0.5 * base)), jnp.stack((jnp.float32(1.0), 0.5 * base)))
    )
    curvature, linear = to_wheels.T @ matrix @ to_wheels, to_wheels.T @ right
    limit = limits(params)
    free = jnp.linalg.solve(curvature, linear[:, None])[:, 0]
    candidates = [free]
    for fixed, bound in itertools.product((0, 1), (-limit, limit)):
        other = 1 - fixed
        slope = linear[other] - curvature[fixed, other] * bound[fixed]
        rest = jnp.clip(slope / curvature[other, other], -limit[other], limit[other])
        candidates.append(jnp.stack((bound[0], rest) if fixed == 0 else (rest, bound[1])))
    commands = jnp.stack(candidates)
    losses = jnp.sum((commands @ curvature - 2.0 * linear[None, :]) * commands, axis=1)
    outside = jnp.any(jnp.abs(free) > limit)
    losses = losses.at[0].set(jnp.where(outside, jnp.inf, -jnp.inf))
    return commands[jnp.argmin(losses)]
