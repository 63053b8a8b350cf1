"""`from_gymnasium`: any Gymnasium environment for the trainer."""

import hashlib
import math
import pickle
from collections.abc import Callable, Iterable
from typing import Any

import gymnasium

from rtd3jax.envs.compat.simulated_environment import FromGymnasium
from rtd3jax.envs.compat.simulator import Fleet, say
from rtd3jax.envs.compat.surface import surface_of
from rtd3jax.errors import UserError, nearest, short_reason, typed_reason

PREFIX = "gymnasium:"
"""Before an id of Gymnasium's where an environment is named."""

STEP_SECONDS = 60.0
"""The longest that a call of a simulator may take by default."""


def from_gymnasium(
    env: str | Callable[[], gymnasium.Env],
    *,
    keep: Iterable[int] | slice | None = None,
    max_steps_in_episode: int | None = None,
    step_seconds: float = STEP_SECONDS,
    **kwargs: Any,
) -> FromGymnasium:
    """A Gymnasium environment for `train`, `disturb`, `evaluate` and all else.

    ``rtd.from_gymnasium("HalfCheetah-v5", keep=slice(8))`` hides the velocities. The simulator runs
    on the host, an instance for each lane and each episode of an evaluation. Every episode begins
    with ``reset(seed=...)``, its seed drawn from the lane's.

    Args:
        env: an id, or a function without arguments that makes an environment.
        keep: indices, or a slice, of the elements that are seen; all by default. Dict and Tuple
            observations are concatenated first; ``element_names`` names the elements.
        max_steps_in_episode: the time limit, a truncation; the environment's own by default, else
            10,000.
        step_seconds: the longest that a call may take before its lane is lost; 60 by default.
        **kwargs: to ``gymnasium.make`` or the function.

    Raises:
        UserError: for what cannot be made or learned from, with the remedy.
    """
    title = env if isinstance(env, str) else getattr(env, "__name__", type(env).__name__)
    if isinstance(env, gymnasium.Env | gymnasium.vector.VectorEnv):
        raise UserError(
            f"{type(env).__name__} is one environment, and each lane needs its own: give its id, "
            "or a function that makes it"
        )
    if not isinstance(env, str) and not callable(env):
        raise UserError(f"{env!r} is neither an id of Gymnasium nor a function that makes one")
    if isinstance(step_seconds, bool) or not 0 < step_seconds < math.inf:
        raise UserError(f"step_seconds={step_seconds!r} must be a number of seconds above 0")

    def make() -> gymnasium.Env:
        if not isinstance(env, str):
            return env(**kwargs)
        limit = {} if max_steps_in_episode is None else {"max_episode_steps": max_steps_in_episode}
        return gymnasium.make(env, **{**limit, **kwargs})

    example = _example(make, env, title)
    try:
        surface, read = surface_of(example, title, keep, max_steps_in_episode)
    finally:
        _close(example)
    key = (env, _named(kwargs), surface.keep, surface.limit, float(step_seconds))
    if key not in _known:
        _known[key] = Fleet(make, read, float(step_seconds))
    return FromGymnasium(key, title, _known[key], surface)


_known: dict[tuple, Fleet] = {}


def _named(kwargs: dict[str, Any]) -> str:
    """Keywords in a form that differs where they do: arrays print a part of themselves alone."""
    try:
        code = pickle.dumps(sorted(kwargs.items()))
    except Exception:  # what cannot be pickled is the same as itself alone
        return repr([(name, id(value)) for name, value in sorted(kwargs.items())])
    return hashlib.sha256(code).hexdigest()[:16] if kwargs else ""


def _example(make: Callable[[], Any], env: object, title: str) -> gymnasium.Env:
    try:
        example = make()
    except (gymnasium.error.DependencyNotInstalled, ImportError) as error:
        raise UserError(
            f"{title} needs a package that is missing ({short_reason(error)}): "
            "pip install 'rtd3jax[mujoco]' for those of MuJoCo"
        ) from error
    except gymnasium.error.UnregisteredEnv as error:
        raise UserError(
            f"Gymnasium has no environment {title!r}{nearest(title, gymnasium.registry)}; "
            "import the module that registers it (--import in a sweep)"
        ) from error
    except Exception as error:
        raise UserError(f"{title} cannot be made: {typed_reason(error)}") from error
    if isinstance(example, gymnasium.vector.VectorEnv):
        _close(example)
        raise UserError(
            f"{title} makes a vector environment; give a function that makes one environment: "
            "every lane makes its own"
        )
    for method in ("reset", "step", "action_space", "observation_space"):
        if not hasattr(example, method):
            raise UserError(
                f"{title} made a {type(example).__name__}, which has no {method}: it is not a "
                "gymnasium.Env"
            )
    return example


def _close(example: gymnasium.Env | gymnasium.vector.VectorEnv) -> None:
    try:
        example.close()
    except Exception as error:
        say(f"close of {type(example).__name__} raised {typed_reason(error)}")
