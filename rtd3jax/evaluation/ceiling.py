"""The best possible mean return of an environment."""

import numpy as np

from rtd3jax.envs.description import Ceiling
from rtd3jax.envs.entry import parameters_of
from rtd3jax.envs.interface import environment_name
from rtd3jax.envs.registry import description_of
from rtd3jax.errors import UserError, short_reason
from rtd3jax.evaluation.returns import evaluate
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.system.numbers import check_counts, standard_error


def ceiling(
    env: EnvironmentLike, episodes: int = 20_000, seed: int = 0, *, env_id: str | None = None
) -> Ceiling:
    """The best possible mean return of ``env``, or an upper bound; ``kind`` states which.

    Args:
        env: an environment that was registered with a ceiling, such as the rover and the pendulum;
            it may be disturbed.
        episodes: number of episodes, if the ceiling is a mean over random episodes. The pendulum's
            ceiling is an integral over all starts, which needs none.
        seed: seed of these episodes. The standard error of a single episode is NaN.
        env_id: the id of the environment; by default the id of an equal environment.

    Raises:
        UserError: for an unsuitable environment, impossible arguments, an environment whose ceiling
            is not known, or when its computation fails.
    """
    check_counts(episodes, seed)
    parameters_of(env)
    episodes, seed = int(episodes), int(seed)
    best_return = description_of(env, env_id).ceiling
    name = environment_name(env)
    if best_return is None:
        raise UserError(
            f"the ceiling of {name} is not known: pass one to rtd.register(..., ceiling=...)"
        )
    try:
        best = best_return(env, episodes, seed)
    except UserError:
        raise
    except Exception as error:  # a user's function may raise any error
        raise UserError(f"the ceiling of {name} failed: {short_reason(error)}") from error
    if isinstance(best, Ceiling):
        return best
    returns = np.asarray(evaluate(best, env, episodes, seed), np.float64)
    return Ceiling(float(returns.mean()), standard_error(returns), "exact")
