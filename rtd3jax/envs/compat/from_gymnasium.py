"""`from_gymnasium`: wraps any Gymnasium environment for the trainer."""

import dataclasses
import hashlib
import math
import pathlib
import pickle
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.envs.registration import load_env_creator

from rtd3jax.envs.compat.simulated_environment import FromGymnasium
from rtd3jax.envs.compat.simulator import Fleet, say
from rtd3jax.envs.compat.surface import surface_of
from rtd3jax.envs.words import in_words
from rtd3jax.errors import UserError, nearest, short_reason, typed_reason

PREFIX = "gymnasium:"
"""The prefix of an id of Gymnasium in the name of an environment."""

STEP_SECONDS = 60.0
"""Default limit of the duration of one call of a simulator, in seconds."""


def from_gymnasium(
    env: str | Callable[[], gymnasium.Env],
    *,
    keep: Iterable[int] | slice | None = None,
    max_steps_in_episode: int | None = None,
    step_seconds: float = STEP_SECONDS,
    **kwargs: Any,
) -> FromGymnasium:
    """Wrap a Gymnasium environment as a gymnax environment, for training and evaluation.

    ``rtd.from_gymnasium("HalfCheetah-v5", keep=slice(8))`` hides the velocities. The simulator runs
    on the host; each lane and each episode of an evaluation has its own instance. Every episode
    begins with ``reset(seed=...)``, whose seed is drawn from the random numbers of the lane.

    Args:
        env: an id, or a function that makes an environment. Checkpoints belong to an id or a class
            by its name; to a function by its name, its code, its defaults and its closure; and to
            the function and the arguments of a `functools.partial`.
        keep: indices of the observed elements, or a slice; all by default. Dict and Tuple
            observations are concatenated first; ``element_names`` names the elements.
        max_steps_in_episode: the time limit, a truncation; by default the environment's own limit,
            or else 10,000.
        step_seconds: limit of the duration of one call of the simulator, in seconds; a lane whose
            simulator exceeds it is lost.
        **kwargs: arguments of ``gymnasium.make``, or of the function. Two environments are equal,
            and share compiled programs, if these have equal data, and all else in them, such as
            functions, is the same object: with an edited function, it is another environment.

    Raises:
        UserError: if the environment cannot be made, or cannot be used for training.
    """
    title = env if isinstance(env, str) else getattr(env, "__name__", type(env).__name__)
    if isinstance(env, gymnasium.Env | gymnasium.vector.VectorEnv):
        raise UserError(
            f"{type(env).__name__} is one environment, and each lane needs its own: give its id, "
            "or a function that makes it"
        )
    if not isinstance(env, str) and not callable(env):
        raise UserError(f"{env!r} is neither an id of Gymnasium nor a function that makes one")
    number = isinstance(step_seconds, int | float | np.integer | np.floating)
    if not number or isinstance(step_seconds, bool) or not 0 < step_seconds < math.inf:
        raise UserError(f"step_seconds={step_seconds!r} must be a number of seconds above 0")
    _check_hashable(env, title)
    # Before the first call, because a function may count its calls.
    words = in_words(env) if not isinstance(env, str | type) else title, _keywords(kwargs)

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
    # A text cannot tell whether a function or a class of the same name is the same code.
    code = [*(_registered(example) if isinstance(env, str) else ()), *_opaque(kwargs)]
    made = (key, *map(id, code))
    if made not in _known:
        _known[made] = Fleet(make, read, float(step_seconds)), code
    return FromGymnasium(key, words, title, _known[made][0], surface)


_known: dict[tuple, tuple[Fleet, list[object]]] = {}
"""The simulators of each environment, and the objects whose ids are in the key. The objects are
kept so that no other object gets their ids."""

_PLAIN = (type(None), bool, int, float, complex, str, bytes)
_DATA = (np.generic, jax.Array, pathlib.PurePath)


def _registered(example: gymnasium.Env) -> Iterator[object]:
    """The entry of an environment's id in Gymnasium's registry, and what makes the environment."""
    spec = gymnasium.registry.get(example.spec.id) if example.spec is not None else None
    if spec is not None:
        yield spec
        if isinstance(spec.entry_point, str):
            yield load_env_creator(spec.entry_point)


def _opaque(value: object) -> Iterator[object]:
    """All parts of ``value`` that are neither plain data nor arrays, such as functions.

    The parts of a dataclass are its class and the values of its fields. An instance of a subclass
    of a plain type is not plain data, because its methods are code.
    """
    if isinstance(value, Iterable) and type(value) in (list, tuple, set, frozenset, dict):
        for part in value.items() if isinstance(value, dict) else value:
            yield from _opaque(part)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield type(value)
        for field in dataclasses.fields(value):
            yield from _opaque(getattr(value, field.name))
    elif isinstance(value, np.ndarray):
        yield from [value] if value.dtype.hasobject else []
    elif type(value) not in _PLAIN and not isinstance(value, _DATA):
        yield value


def _check_hashable(env: object, title: str) -> None:
    try:
        hash(env)
    except TypeError as error:
        raise UserError(
            f"{title} cannot be hashed ({error}), so compiled programs cannot be kept for it: make "
            "it a @dataclass(frozen=True), or pass a function that makes the environment"
        ) from error


def _named(kwargs: dict[str, Any]) -> str:
    """A text that differs for different keywords, unlike ``repr``, which shortens large arrays."""
    # An object that cannot be pickled only equals itself.
    return _pickled(kwargs) or repr([(name, id(value)) for name, value in sorted(kwargs.items())])


def _keywords(kwargs: dict[str, Any]) -> str:
    """A text for files that differs for different keywords: it contains no ids."""
    if not kwargs:
        return ""
    return _pickled(kwargs) or in_words(dict(sorted(kwargs.items())))


def _pickled(kwargs: dict[str, Any]) -> str | None:
    """A digest of keywords; None if one of them cannot be pickled."""
    try:
        code = pickle.dumps(sorted(kwargs.items()))
    except Exception:  # code of others may raise anything
        return None
    return hashlib.sha256(code).hexdigest()[:16]


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
