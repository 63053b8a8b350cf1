"""Wraps gymnax environments as Gymnasium environments, with numpy arrays, seeded by reset.

gymnax imports gymnasium already, so this module does not make the import of rtd3jax slower.
"""

import functools
import os
import weakref
from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import spaces
from jax.typing import ArrayLike

from rtd3jax.envs.builtin import LISTED
from rtd3jax.envs.compat.simulated import release
from rtd3jax.envs.entry import parameters_of
from rtd3jax.envs.interface import (
    check_final_observation,
    environment_name,
    foreign_code,
    trace_reset,
    trace_step,
)
from rtd3jax.envs.registry import make
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike

NAMESPACE = "rtd3jax"

_PROCESS = os.getpid()
"""Id of the process that imported JAX; a forked process inherits its locks but not its threads."""

_seen: dict[Any, tuple[gymnasium.Space, gymnasium.Space]] = {}
"""Spaces of the environments that were made. A forked process cannot compute spaces and reads them
here. The spaces of an object are removed with the object; of names, the last `_MOST_SEEN` are kept.
"""
_MOST_SEEN = 256


def _check_process() -> None:
    """Raise UserError in a forked process, in which JAX would hang."""
    if os.getpid() != _PROCESS:
        raise UserError(
            "JAX hangs in a forked process; start processes with "
            'spawn: AsyncVectorEnv(..., context="spawn"), or gymnasium.make_vec(..., '
            'vectorization_mode="async", vector_kwargs={"context": "spawn"})'
        )


class GymnasiumEnv(gymnasium.Env):
    """Gymnasium's interface around a gymnax environment; made by `to_gymnasium`.

    Reset and step are compiled programs. At the end of an episode, ``step`` returns the final
    observation; only ``reset`` begins a new episode. The time limit sets ``truncated``. ``info``
    holds the environment's entries as numpy arrays. With ``render_mode="rgb_array"``, ``render``
    returns a picture, uint8 [height, width, 3].
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(self, env: Any, params: Any = None, render_mode: str | None = None) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise UserError(f"render_mode {render_mode!r} is unknown; choose 'rgb_array' or None")
        self.render_mode = render_mode
        self._episode: Any = None
        self.environment = env
        self.params = parameters_of(env, params)
        self.action_space, self.observation_space = _spaces(env, self.params)
        self._key: Any = None
        self._state: Any = None
        self._time = 0
        self._over = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; ``seed`` determines it and all episodes until the next ``seed``."""
        _check_process()
        super().reset(seed=seed)
        self._key = np.uint32(self.np_random.integers(2**32, dtype=np.uint32))
        self._release()
        self._time, self._over = 0, False
        observation, self._state = _reset(self.environment, self.params, self._key)
        observation = self._observation(observation)
        if self.render_mode is not None:
            if self._episode is None:
                from rtd3jax.envs.compat.frames import Episode

                self._episode = Episode(self.environment, self.params)
            self._episode.begin(observation, self._state)
        return observation, {}

    def step(self, action: ArrayLike) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One step of the episode; raises gymnasium.error.ResetNeeded after its end."""
        _check_process()
        if self._over:
            raise gymnasium.error.ResetNeeded("no episode is running: call reset")
        action = np.asarray(action, self.action_space.dtype).reshape(self.action_space.shape)
        time = np.uint32(self._time)
        final, self._state, reward, terminated, truncated, info = _step(
            self.environment, self.params, self._key, time, self._state, action
        )
        self._time += 1
        self._over = bool(terminated) or bool(truncated)
        info = jax.tree.map(np.asarray, info)
        observation = self._observation(final)
        if self._episode is not None:
            self._episode.add(action, observation, float(reward), info)
        return observation, float(reward), bool(terminated), bool(truncated), info

    def close(self) -> None:
        """End the episode; its simulator, if there is one, becomes free for another episode."""
        self._release()
        self._over = True
        super().close()

    def _release(self) -> None:
        release(self.environment, self._state)
        self._state = None

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """A frame, uint8 [height, width, 3]; without a render mode, None and a warning."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                'render() needs a mode: pass render_mode="rgb_array" when you make the environment'
            )
            return None
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset")
        return self._episode.frame()

    def _observation(self, observation: Any) -> np.ndarray:
        return np.asarray(observation, self.observation_space.dtype)


class _Forked(GymnasiumEnv):
    """Replaces an environment in a forked process, and raises the error at reset.

    An error that a process of a vector environment raises before reset does not reach the parent.
    """

    def __init__(self, key: Any, render_mode: str | None) -> None:
        if key not in _seen:
            _check_process()
        self.render_mode, self.environment = render_mode, None
        self._state = self._episode = None
        self.action_space, self.observation_space = _seen[key]


def to_gymnasium(env: Any, *, params: Any = None, render_mode: str | None = None) -> GymnasiumEnv:
    """Wrap any gymnax >= 1.0 environment as a ``gymnasium.Env``; its actions may be discrete.

    After ``import rtd3jax``, ``gymnasium.make("rtd3jax/Rover-ar1-slip-v0", sigma=0.1)`` does the
    same by name; ``gymnasium.make("rtd3jax:rtd3jax/Rover-ar1-slip-v0")`` imports rtd3jax itself.

    Args:
        env: the environment; its time limit is reported as ``truncated``.
        params: the environment's parameters; its default parameters by default.
        render_mode: ``rgb_array``, so that ``render`` returns pictures, or None.

    Raises:
        UserError: if ``env`` is not a gymnax >= 1.0 environment, or in a forked process.
    """
    made = _construct(id(env), render_mode, lambda: GymnasiumEnv(env, params, render_mode))
    try:
        weakref.finalize(env, _seen.pop, id(env), None)
    except TypeError:  # an object without weak references: its spaces are not kept
        _seen.pop(id(env), None)
    return made


def make_gymnasium(
    env_id: str, disturbance: str, render_mode: str | None = None, **parameters: Any
) -> GymnasiumEnv:
    """The entry point of the ids that are registered with Gymnasium."""
    key = env_id, disturbance, repr(parameters)

    def construct() -> GymnasiumEnv:
        return GymnasiumEnv(make(env_id, disturbance, **parameters), render_mode=render_mode)

    return _construct(key, render_mode, construct)


# gymnasium.make reads the render modes here, to offer others such as "rgb_array_list".
make_gymnasium.metadata = GymnasiumEnv.metadata  # type: ignore[attr-defined]


def _construct(
    key: Any, render_mode: str | None, construct: Callable[[], GymnasiumEnv]
) -> GymnasiumEnv:
    """The environment that ``construct`` makes; in a forked process, its replacement."""
    if os.getpid() != _PROCESS:
        return _Forked(key, render_mode)
    env = construct()
    _seen[key] = env.action_space, env.observation_space
    while len(_seen) > _MOST_SEEN:
        del _seen[next(iter(_seen))]
    return env


def gymnasium_id(env_id: str, disturbance: str) -> str:
    """``rtd3jax/RoverSoil-mixed-v0`` for `rover-soil` under `mixed`."""
    name = "".join(part.capitalize() for part in env_id.split("-"))
    return f"{NAMESPACE}/{name}-{disturbance}-v0"


def register_with_gymnasium() -> None:
    """Register every environment of this package with each of its disturbances; none is made."""
    for env_id, disturbances in LISTED.items():
        for disturbance in disturbances:
            if gymnasium_id(env_id, disturbance) not in gymnasium.registry:
                gymnasium.register(
                    id=gymnasium_id(env_id, disturbance),
                    entry_point=f"{__name__}:make_gymnasium",
                    kwargs={"env_id": env_id, "disturbance": disturbance},
                )


def _spaces(env: EnvironmentLike, params: object) -> tuple[gymnasium.Space, gymnasium.Space]:
    """Spaces of actions and observations; UserError if ``env`` is not a gymnax environment."""
    name = environment_name(env)
    with foreign_code():
        actions = _gymnasium_space(name, "action", env.action_space(params))
    observation, state = trace_reset(env, params)
    action = jax.ShapeDtypeStruct(actions.shape or (), actions.dtype or jnp.float32)
    after = trace_step(env, params, state, action)
    if not hasattr(observation, "dtype"):
        raise UserError(
            f"environment {name}: the observation is a {type(observation).__name__}; "
            "concatenate its parts into one array"
        )
    check_final_observation(name, after[-1], observation)
    declaring: Any = env
    try:
        with foreign_code():
            seen = _gymnasium_space(name, "observation", declaring.observation_space(params))
    except (AttributeError, NotImplementedError):
        seen = gymnasium.spaces.Box(-np.inf, np.inf, observation.shape, np.float32)
    if seen.shape != observation.shape:
        raise UserError(
            f"environment {name}: observation_space has shape {seen.shape}, "
            f"the observation {observation.shape}; make them the same"
        )
    return actions, seen


def _gymnasium_space(name: str, what: str, space: object) -> gymnasium.Space:
    if isinstance(space, spaces.Discrete):
        return gymnasium.spaces.Discrete(int(space.n))
    if not isinstance(space, spaces.Box):
        raise UserError(
            f"environment {name}: the {what} space {type(space).__name__} is neither Box nor "
            f"Discrete; flatten the {what} into one Box"
        )
    dtype = np.dtype(space.dtype)
    low, high = (
        np.broadcast_to(np.asarray(bound, dtype), space.shape) for bound in (space.low, space.high)
    )
    return gymnasium.spaces.Box(low, high, tuple(space.shape), dtype.type)


@functools.partial(jax.jit, static_argnames="env")
def _reset(env: EnvironmentLike, params: object, key: jax.Array) -> tuple[jax.Array, Any]:
    with foreign_code():
        return env.reset(jax.random.key(key), params)


@functools.partial(jax.jit, static_argnames="env")
def _step(
    env: EnvironmentLike,
    params: object,
    key: jax.Array,
    time: jax.Array,
    state: object,
    action: jax.Array,
) -> tuple:
    """The six values of step, with the observation before an automatic reset."""
    # The key must differ from the key of reset, which is the episode's key itself.
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(key), 1 << 31), time)
    with foreign_code():
        _, state, reward, terminated, truncated, info = env.step(key, state, action, params)
    final = info["final_observation"]
    rest = {
        name: value
        for name, value in info.items()
        if name not in ("final_observation", "terminated", "truncated")
    }
    return final, state, jnp.asarray(reward, jnp.float32), terminated, truncated, rest
