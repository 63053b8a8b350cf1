"""The pendulum's best possible return, from its true state.

It is the fully observable optimum, by `rtd3jax.envs.pendulum.value_iteration`; it bounds every
disturbed case from above. `rtd3jax.envs.pendulum.filter` has a policy that bounds some of them from
below.
"""

from rtd3jax.envs.description import Ceiling
from rtd3jax.envs.disturbed import Disturbed
from rtd3jax.envs.pendulum.value_iteration import mean_optimal_return
from rtd3jax.envs.processes.process import NoDisturbance
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike


def best_return(env: EnvironmentLike, episodes: int = 0, seed: int = 0) -> Ceiling:
    """The undisturbed optimum: no disturbed pendulum can do better by its true state's reward.

    It is an integral over all starts, which needs neither episodes nor a seed.

    Raises:
        UserError: when the reward is itself disturbed.
    """
    params, disturbed = env.default_params, False
    if isinstance(env, Disturbed):
        if env.reward_from != "state" or not isinstance(params.reward, NoDisturbance):
            raise UserError(
                "a reward that is itself disturbed has no known ceiling; "
                "make the environment with reward_from='state'"
            )
        disturbed = not (
            isinstance(params.observation, NoDisturbance)
            and isinstance(params.action, NoDisturbance)
        )
        params = params.env
    mean, error = mean_optimal_return(params)
    return Ceiling(mean, error, "upper bound" if disturbed else "exact")
