"""Checks of an environment that a caller passes, and its parameters."""

import dataclasses
from typing import Any

import gymnasium
import jax

from rtd3jax.envs.processes.process import check_uses
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.system.switches import check_switches

DEFAULT_STEP_LIMIT = 10_000
"""The time limit of an episode, in steps, if the environment names none."""

METHODS = ("reset", "step", "action_space")
"""Methods that every gymnax environment has."""


def step_limit(params: object) -> Any:
    """The time limit of an episode, in steps; it may be traced."""
    return getattr(params, "max_steps_in_episode", DEFAULT_STEP_LIMIT)


def parameters_of(env: EnvironmentLike, params: object = None) -> Any:
    """``params``, or the default parameters of ``env`` for None.

    Every function that takes an environment calls this first.

    Raises:
        UserError: if ``env`` is not a gymnax >= 1.0 environment, if its method ``check_params``
            refuses the parameters, if a disturbance cannot act in its episodes, or if one of JAX's
            switches prevents evaluation and training.
    """
    check_switches()
    params = own_parameters(env, params)
    check_uses(params, step_limit(params))
    base: Any = env
    own = params
    while hasattr(base, "base"):  # the wrapped environment
        base, own = base.base, getattr(own, "env", own)
    if callable(check := getattr(base, "check_params", None)):
        check(own)
    return params


def _check_kind(env: Any, params: object) -> None:
    """Raise UserError if ``params`` belong to the wrapped environment, or JAX cannot trace them."""
    own = getattr(env, "default_params", None)
    if hasattr(env, "base") and hasattr(own, "env") and not hasattr(params, "env"):
        raise UserError(
            f"params are a {type(params).__name__}, but the environment is disturbed: pass "
            "params=env.default_params.replace(env=...)"
        )
    if dataclasses.is_dataclass(params) and jax.tree_util.all_leaves([params]):
        raise UserError(
            f"params are a {type(params).__name__}, a dataclass that JAX does not know: decorate "
            "it with flax.struct.dataclass"
        )


def own_parameters(env: EnvironmentLike, params: object = None) -> Any:
    """As `parameters_of`, without the checks of disturbances, parameters and JAX's switches."""
    check_gymnax(env)
    if params is not None:
        _check_kind(env, params)
        return params
    try:
        return env.default_params
    except AttributeError as error:
        raise UserError(
            f"{type(env).__name__} has no default_params, as gymnax environments have: "
            "add this property, or pass params=..."
        ) from error


def check_gymnax(env: object) -> None:
    """Raise UserError, with what to do instead, unless ``env`` looks like a gymnax environment."""
    if isinstance(env, str):
        raise UserError(
            f"{env!r} is a name, not an environment: make the environment first, rtd.make({env!r})"
        )
    if isinstance(env, type):
        raise UserError(
            f"{env.__name__} is a class, not an environment: make an instance, {env.__name__}()"
        )
    if isinstance(env, tuple):
        raise UserError(
            "this is a tuple, not an environment: gymnax.make returns (env, params); "
            "pass env, and params=params if they differ from its default parameters"
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
