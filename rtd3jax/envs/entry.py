"""What a user gives as an environment: a gymnax one, or refused with the remedy."""

from typing import Any

import gymnasium

from rtd3jax.envs.processes.process import check_uses
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.system.switches import check_switches

DEFAULT_STEP_LIMIT = 10_000
"""Steps after which an episode is cut where the environment names no time limit of its own."""

METHODS = ("reset", "step", "action_space")
"""Without these nothing is a gymnax environment."""


def parameters_of(env: EnvironmentLike, params: object = None) -> Any:
    """``params``, or the default parameters of ``env`` for None.

    Every function that takes an environment calls this first.

    Raises:
        UserError: for what is no gymnax >= 1.0 environment, for a disturbance that cannot act
            in its episodes, or under one of JAX's switches with which nothing here can work.
    """
    check_switches()
    params = own_parameters(env, params)
    check_uses(params, DEFAULT_STEP_LIMIT)
    return params


def own_parameters(env: EnvironmentLike, params: object = None) -> Any:
    """`parameters_of` where nothing is computed, such as at an import: under any switch."""
    check_gymnax(env)
    if params is not None:
        return params
    try:
        return env.default_params
    except AttributeError as error:
        raise UserError(
            f"{type(env).__name__} has no default_params, as gymnax environments have: "
            "add the property, or give params=..."
        ) from error


def check_gymnax(env: object) -> None:
    """Raise UserError, with what to do instead, unless ``env`` looks like a gymnax environment."""
    if isinstance(env, str):
        raise UserError(
            f"{env!r} is a name, not an environment: make the environment first, rtd.make({env!r})"
        )
    if isinstance(env, type):
        raise UserError(
            f"{env.__name__} is a class, not an environment: make one of it, {env.__name__}()"
        )
    if isinstance(env, tuple):
        raise UserError(
            "this is a tuple, not an environment: gymnax.make returns (env, params); "
            "give env, and params=params if they are not its own"
        )
    if isinstance(env, gymnasium.Env | gymnasium.vector.VectorEnv):
        raise UserError(
            f"{env} is a Gymnasium environment: train on it by rtd.from_gymnasium(id, or a "
            "function that makes it), or play a trained policy in it by rtd.run_in_gymnasium"
        )
    if hasattr(env, "action_size") and hasattr(env, "observation_size"):
        raise UserError(
            f"{type(env).__name__} looks like a Brax or MuJoCo Playground environment: "
            "wrap it by rtd.from_brax"
        )
    for method in METHODS:
        if not callable(getattr(env, method, None)):
            raise UserError(
                f"{type(env).__name__} has no method {method}: it is not a gymnax environment "
                "(gymnax >= 1.0: reset(key, params), step(key, state, action, params), "
                "action_space(params))"
            )
