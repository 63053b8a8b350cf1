"""Wraps environments with Brax's interface, such as those of MuJoCo Playground, for gymnax.

Such an environment has ``reset(rng) -> State`` and ``step(state, action) -> State``. Its State has
the fields obs, reward, done, metrics and info. Actions lie within [-1, 1], and random numbers come
from a key in the state. Nothing is imported from Brax unless an environment is made by its name.
"""

from collections.abc import Iterable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnax.environments import environment, spaces
from jax.typing import ArrayLike

from rtd3jax.envs.compat.elements import kept_elements, time_limit
from rtd3jax.envs.identity import ValueIdentity, strong
from rtd3jax.envs.interface import foreign_code
from rtd3jax.errors import UserError, nearest, typed_reason

DEFAULT_EPISODE_LENGTH = 1_000
"""Default time limit in steps, as in Brax and in MuJoCo Playground's control suite."""


class BraxStateLike(Protocol):
    """The State of such an environment; its fields are arrays, or dicts of arrays."""

    obs: Any
    reward: Any
    done: Any
    metrics: Any
    info: Any


class BraxLike(Protocol):
    """An environment with Brax's interface."""

    @property
    def action_size(self) -> int:
        """Elements of an action, which lie within [-1, 1]."""

    def reset(self, rng: jax.Array, /) -> Any:
        """The first State of an episode."""

    def step(self, state: Any, action: jax.Array, /) -> Any:
        """The next State."""


class BraxParams(struct.PyTreeNode):
    """Parameters of `BraxEnv`; the wrapped environment keeps all others itself."""

    max_steps_in_episode: int = DEFAULT_EPISODE_LENGTH


class BraxState(struct.PyTreeNode):
    """The state of one episode."""

    time: jax.Array
    """int32 []: steps taken"""
    brax: Any
    """the State of the wrapped environment"""


class BraxEnv(ValueIdentity, environment.Environment):
    """Gymnax's interface around an environment with Brax's interface; made by `from_brax`.

    ``done`` is a termination, unless ``info["truncation"]`` marks it as a time limit, as Brax's
    EpisodeWrapper does. The automatic reset is a full reset with a new key; as in all gymnax
    environments, it is computed at every step. ``info["metrics"]`` holds the wrapped environment's
    metrics.
    """

    def __init__(
        self,
        env: BraxLike,
        default_params: BraxParams,
        observation_key: str | None,
        keep: tuple[int, ...],
    ) -> None:
        super().__init__()
        self.brax = env
        self._default_params = default_params
        self._observation_key = observation_key
        self._keep = keep

    def identity(self) -> tuple:
        """The wrapped environment, and the observed elements."""
        return (self.brax, self._observation_key, self._keep)

    @property
    def default_params(self) -> BraxParams:
        """The parameters given at construction."""
        return self._default_params

    def reset_env(self, key: jax.Array, params: BraxParams) -> tuple[jax.Array, BraxState]:
        """Start an episode; returns the observation, float32 [O], and the state."""
        with foreign_code():
            # Brax's code splits keys of JAX's old type, and compares their shapes.
            brax = self.brax.reset(jax.random.key_data(key))
        return self._observe(brax), strong(BraxState(jnp.zeros((), jnp.int32), brax))

    def step_env(
        self, key: jax.Array, state: BraxState, action: ArrayLike, params: BraxParams
    ) -> tuple[jax.Array, BraxState, jax.Array, jax.Array, dict[Any, Any]]:
        """One control step; ``key`` is not used, because the state contains a key."""
        with foreign_code():
            brax = self.brax.step(state.brax, jnp.asarray(action, jnp.float32))
            # A flag that is float32 at reset may be bool after a step, for example.
            brax = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), brax, state.brax)
        evolved = strong(BraxState(state.time + 1, brax))
        reward = jnp.asarray(brax.reward, jnp.float32)
        info = {"metrics": brax.metrics}
        return self._observe(brax), evolved, reward, self.is_terminated(evolved, params), info

    def _observe(self, brax: BraxStateLike) -> jax.Array:
        observation = brax.obs
        if self._observation_key is not None:
            observation = observation[self._observation_key]
        return jnp.asarray(observation, jnp.float32)[np.asarray(self._keep)]

    def is_terminated(self, state: BraxState, params: BraxParams) -> jax.Array:
        """Whether the episode terminated."""
        return state.brax.done.astype(bool) & ~_truncation(state.brax)

    def is_truncated(self, state: BraxState, params: BraxParams) -> jax.Array:
        """Whether this time limit, or one of the wrapped environment, was reached."""
        return (state.time >= params.max_steps_in_episode) | _truncation(state.brax)

    @property
    def name(self) -> str:
        """The name of the environment's class."""
        return type(getattr(self.brax, "unwrapped", self.brax)).__name__

    @property
    def num_actions(self) -> int:
        """Elements of an action."""
        return self.brax.action_size

    def action_space(self, params: BraxParams | None = None) -> spaces.Box:
        """Actions within [-1, 1], as Brax's environments expect."""
        return spaces.Box(-1.0, 1.0, (self.brax.action_size,), jnp.float32)

    def observation_space(self, params: BraxParams | None = None) -> spaces.Box:
        """A Box without bounds."""
        return spaces.Box(-jnp.inf, jnp.inf, (len(self._keep),), jnp.float32)


def from_brax(
    env: BraxLike,
    *,
    max_steps_in_episode: int | None = None,
    observation_key: str | None = None,
    keep: Iterable[int] | slice | None = None,
) -> BraxEnv:
    """Wrap an environment with Brax's interface as a gymnax environment.

    ``rtd.from_brax("CheetahRun", keep=range(8))`` observes positions and hides velocities.

    Args:
        env: an environment of MuJoCo Playground or Brax, without wrappers that vmap or reset it; or
            the name of an environment of MuJoCo Playground
            (``pip install 'rtd3jax[playground]'``), which is then made with MJX's JAX physics.
        max_steps_in_episode: the time limit, a truncation; by default the limit of the named
            environment, or else 1,000.
        observation_key: the key of the observation, if there is a dict of observations; "state" by
            default.
        keep: indices of the observed elements, or a slice; all by default.

    Raises:
        UserError: if ``env`` is not such an environment, or does not have the indices.
    """
    if isinstance(env, str):
        env, length = _load(env)
        max_steps_in_episode = length if max_steps_in_episode is None else max_steps_in_episode
    name = type(env).__name__
    for attribute in ("reset", "step", "action_size"):
        if not hasattr(env, attribute):
            raise UserError(
                f"{name} has no {attribute}: it does not have Brax's interface "
                "(reset(rng), step(state, action), action_size)"
            )
    length = time_limit(
        DEFAULT_EPISODE_LENGTH if max_steps_in_episode is None else max_steps_in_episode
    )
    observation_key, size = _observation(name, _first_state(env, name), observation_key)
    indices = kept_elements(keep, size, name)
    return BraxEnv(env, BraxParams(length), observation_key, indices)


def _truncation(brax: BraxStateLike) -> jax.Array:
    """bool []: the flag that an EpisodeWrapper sets; False without the wrapper."""
    return jnp.asarray(brax.info.get("truncation", False)).astype(bool)


def _load(name: str) -> tuple[Any, int]:
    """An environment of MuJoCo Playground, and the length of its episodes."""
    try:
        from mujoco_playground import registry
    except ImportError as error:
        raise UserError(
            f"{name!r} is an environment of MuJoCo Playground: pip install 'rtd3jax[playground]'"
        ) from error
    if name not in registry.ALL_ENVS:
        raise UserError(f"MuJoCo Playground has no {name!r}{nearest(name, registry.ALL_ENVS)}")
    config = registry.get_default_config(name)
    overrides = {"impl": "jax"} if "impl" in config else {}
    return registry.load(name, config_overrides=overrides), int(config.episode_length)


def _first_state(env: BraxLike, name: str) -> BraxStateLike:
    """Shapes of the State that reset returns."""
    key = jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0)))
    try:
        with foreign_code():
            state = jax.eval_shape(env.reset, key)
    except Exception as error:
        raise UserError(f"{name} failed in reset: {typed_reason(error)}") from error
    missing = [f for f in ("obs", "reward", "done", "metrics", "info") if not hasattr(state, f)]
    if missing:
        raise UserError(f"{name}: the State of reset has no {', '.join(missing)}")
    if any(str(key).endswith("first_obs") for key in state.info):
        raise UserError(
            f"{name} resets automatically, which hides the final observation of an episode: "
            "pass the environment without its AutoResetWrapper"
        )
    if state.reward.shape:
        raise UserError(
            f"{name} is a batch of {state.reward.shape[0]}: pass the environment without its "
            "VmapWrapper"
        )
    return state


def _observation(name: str, state: BraxStateLike, key: str | None) -> tuple[str | None, int]:
    """The key of the observation, if there is a dict of observations, and its size."""
    observation = state.obs
    if isinstance(observation, dict) or hasattr(observation, "keys"):
        key = "state" if key is None else key
        if key not in observation:
            raise UserError(
                f"{name} has no observation {key!r} (it has {', '.join(observation)}): "
                "choose one with observation_key"
            )
        observation = observation[key]
    elif key is not None:
        raise UserError(f"{name} has no dict of observations; leave out observation_key")
    if len(observation.shape) != 1:
        raise UserError(
            f"{name}: the observation has shape {observation.shape}; flatten it to one dimension"
        )
    return key, observation.shape[0]
