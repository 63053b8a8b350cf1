"""Makes gymnax's environments by their ids."""

from typing import Any

import gymnax
import jax
from jax.typing import ArrayLike

from rtd3jax.envs.identity import ValueIdentity, strong, with_identity
from rtd3jax.envs.interface import foreign_code
from rtd3jax.errors import UserError, typed_reason


class _Preset(ValueIdentity):
    """A gymnax environment with given ``default_params`` and strongly typed states.

    gymnax's code runs under standard promotion, because it fails under strict promotion.
    """

    _preset_id: str
    _preset_params: Any

    def identity(self) -> tuple:
        """The id: gymnax never registers another environment under the same id."""
        return (self._preset_id,)

    @property
    def default_params(self) -> Any:
        """gymnax's parameters, in which those given to ``make`` are replaced."""
        return self._preset_params

    def step(
        self, key: jax.Array, state: object, action: ArrayLike, params: object = None
    ) -> tuple:
        """gymnax's step, with a strongly typed state."""
        with foreign_code():
            observation, state, *rest = super().step(key, state, action, params)
        return (observation, strong(state), *rest)

    def reset(self, key: jax.Array, params: object = None) -> tuple:
        """gymnax's reset, with a strongly typed state."""
        with foreign_code():
            observation, state = super().reset(key, params)
        return observation, strong(state)


def make_gymnax(env_id: str, params: object = None) -> Any:
    """gymnax's environment with default parameters ``params``; None means gymnax's defaults."""
    try:
        base, defaults = gymnax.make(env_id)
    except Exception as error:
        raise UserError(f"environment {env_id} cannot be made: {typed_reason(error)}") from error
    env: Any = object.__new__(with_identity(_Preset, type(base)))  # type: ignore[arg-type]
    params = defaults if params is None else params
    env.__dict__.update(vars(base), _preset_id=env_id, _preset_params=params)
    return env
