"""The best possible return of an environment, which no trained agent exceeds on average."""

import numpy as np

from rtd3jax.envs.description import Ceiling
from rtd3jax.envs.interface import environment_name
from rtd3jax.envs.registry import description_of
from rtd3jax.errors import UserError, first_line
from rtd3jax.evaluation.rollout import evaluate
from rtd3jax.protocols import EnvironmentLike


def ceiling(
    env: EnvironmentLike, episodes: int = 20_000, seed: int = 0, *, env_id: str | None = None
) -> Ceiling:
    """The best possible mean return of ``env``, or an upper bound that is named as such.

    Args:
        env: an environment that was registered with a ceiling, as the rover and the pendulum are;
            disturbed or not.
        episodes: how many to average where the ceiling is the mean of random episodes. The
            pendulum's is an integral over all starts and needs none.
        seed: of these episodes.
        env_id: the id under which it was registered; by default that of an equal environment.

    Raises:
        UserError: for an environment whose ceiling is not known.
    """
    best_return = description_of(env, env_id).ceiling
    name = environment_name(env)
    if best_return is None:
        raise UserError(f"no ceiling of {name} is known: rtd.register(..., ceiling=...) tells one")
    try:
        best = best_return(env, episodes, seed)
    except UserError:
        raise
    except Exception as error:  # a user's function may do anything
        raise UserError(f"the ceiling of {name} failed: {first_line(error)}") from error
    if isinstance(best, Ceiling):
        return best
    returns = np.asarray(evaluate(best, env, episodes, seed), np.float64)
    return Ceiling(float(returns.mean()), float(returns.std(ddof=1) / np.sqrt(episodes)), "exact")
