"""The best possible return of an environment, which no trained agent exceeds on average."""

from typing import Any

import numpy as np

from rtd3jax.envs.about import Ceiling
from rtd3jax.envs.disturbed import Disturbed
from rtd3jax.envs.pendulum import optimum as pendulum
from rtd3jax.envs.pendulum.environment import Pendulum
from rtd3jax.envs.rover import optimum as rover
from rtd3jax.envs.rover.environment import Rover
from rtd3jax.errors import UserError
from rtd3jax.evaluation.rollout import evaluate


def ceiling(env: Any, episodes: int = 20_000, seed: int = 0) -> Ceiling:
    """The best possible mean return of ``env``, or an upper bound that is named as such.

    Args:
        env: a rover, or a pendulum, disturbed or not.
        episodes: of the rover, how many random ones to average. The pendulum's ceiling is an
            integral over all starts and needs none.
        seed: of the rover's episodes.

    Raises:
        UserError: for a world whose ceiling is not known.
    """
    base = env.base if isinstance(env, Disturbed) else env
    if isinstance(base, Pendulum):
        return pendulum.best_return(env)
    if not isinstance(env, Rover):
        raise UserError("the ceiling is known for the rover and the pendulum alone")
    best = rover.best_return(env, episodes, seed)
    if isinstance(best, Ceiling):
        return best
    returns = np.asarray(evaluate(best, env, episodes, seed), np.float64)
    return Ceiling(float(returns.mean()), float(returns.std(ddof=1) / np.sqrt(episodes)), "exact")
