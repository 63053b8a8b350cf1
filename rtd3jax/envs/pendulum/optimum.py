"""The pendulum's best possible return, from its true state.

`rtd3jax.envs.pendulum.value_iteration` computes this optimum for a fully observed state. It is an
upper bound for every disturbance of the observation. The mean return of the policy of
`rtd3jax.envs.pendulum.filter` is a lower bound for some of them.
"""

from rtd3jax.envs.description import Ceiling
from rtd3jax.envs.disturbed import Disturbed
from rtd3jax.envs.pendulum.value_iteration import mean_optimal_return
from rtd3jax.envs.processes.process import NoDisturbance
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike


def best_return(env: EnvironmentLike, episodes: int = 0, seed: int = 0) -> Ceiling:
    """The optimal return without disturbances: an upper bound of the true return under any.

    The optimum is an integral over all starts, which needs neither ``episodes`` nor ``seed``.

    Raises:
        UserError: when the reward is itself disturbed.
    """
    params, disturbed = env.default_params, False
    if isinstance(env, Disturbed):
        if env.reward_from != "state" or not isinstance(params.reward, NoDisturbance):
            raise UserError(
                "the ceiling under a disturbed reward is not known; "
                "make the environment with reward_from='state'"
            )
        disturbed = not (
            isinstance(params.observation, NoDisturbance)
            and isinstance(params.action, NoDisturbance)
        )
        params = params.env
    mean, error = mean_optimal_return(params)
    return Ceiling(mean, error, "upper bound" if disturbed else "exact")
