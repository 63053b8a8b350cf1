"""A policy from any function."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.envs.identity import strong
from rtd3jax.envs.interface import foreign_code
from rtd3jax.errors import UserError, short_reason

_UNTRACEABLE = (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError)


@struct.dataclass
class FunctionPolicy:
    """``function`` as a policy; see `function_policy`."""

    state: Any
    function: Callable[[Any, jax.Array], Any] = struct.field(pytree_node=False)
    shape: tuple[int, ...] | None = struct.field(pytree_node=False, default=None)

    def with_action_shape(self, shape: tuple[int, ...]) -> "FunctionPolicy":
        """The policy, whose actions get ``shape`` if they have as many elements."""
        return dataclasses.replace(self, shape=shape)

    def init(self, key: jax.Array | None = None) -> Any:
        """The state before the first step of an episode, the same for every episode."""
        return self.state

    def step(self, state: Any, observation: jax.Array) -> tuple[jax.Array, Any]:
        """The function's action, [A] or of ``shape``, and the next state."""
        name = getattr(self.function, "__name__", type(self.function).__name__)
        try:
            with foreign_code():
                returned = self.function(state, observation)
        except _UNTRACEABLE as error:
            raise UserError(
                f"{name} cannot be compiled: use jnp.where for branches, and jax.numpy "
                f"({short_reason(error)})"
            ) from error
        if not isinstance(returned, tuple) or len(returned) != 2:
            raise UserError(f"{name} must return (action, state), not {type(returned).__name__}")
        action, after = returned
        shapes = [jax.tree.map(jnp.shape, tree) for tree in (state, after)]
        structures: list[Any] = [jax.tree.structure(tree) for tree in (state, after)]
        if structures[0] != structures[1] or shapes[0] != shapes[1]:
            raise UserError(
                f"{name} must return a state of the same shapes as its argument: {shapes[0]}, "
                f"not {shapes[1]}"
            )
        for old, new in zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True):
            if _loses(old.dtype, jnp.result_type(new)):
                raise UserError(
                    f"{name} returns a state of {jnp.result_type(new)} for one of {old.dtype}, "
                    "which would lose its fractions: begin with a float, such as state=0.0"
                )
        # A loop needs a state of fixed types, but Python numbers in the function may change them.
        after = jax.tree.map(lambda new, old: jnp.asarray(new).astype(old.dtype), after, state)
        array = jnp.asarray(action, jnp.float32)
        if self.shape is None or array.size != math.prod(self.shape):
            return jnp.atleast_1d(array), after
        return array.reshape(self.shape), after


def _loses(old: jnp.dtype, new: jnp.dtype) -> bool:
    """Whether numbers of type ``new`` lose their fractions in a state of type ``old``."""
    return jnp.issubdtype(new, jnp.inexact) and not jnp.issubdtype(old, jnp.inexact)


def function_policy(
    function: Callable[[Any, jax.Array], tuple[Any, Any]], state: object = ()
) -> FunctionPolicy:
    """Any function ``(state, observation [O]) -> (action [A], state)`` as a policy.

    Where it plays, its action gets the shape of the environment's actions.

    Args:
        function: a pure function in ``jax.numpy``. It is part of the compiled program: define it
            once, because each new function is compiled again.
        state: the state at the first step of an episode, a pytree of numbers and arrays. Its types
            stay the same: begin with 0.0, not with 0, if the function returns floats.

    Raises:
        UserError: if ``function`` is not a function, or JAX does not accept ``state``. Where it
            plays, if the function returns another structure or floats for integers.
    """
    if not callable(function):
        raise UserError(f"function_policy needs a function, not {function!r}")
    try:
        hash(function)
    except TypeError as error:
        raise UserError(f"function_policy needs a hashable function: {error}") from error
    try:
        return FunctionPolicy(strong(state), function)
    except TypeError as error:
        reason = short_reason(error)
        raise UserError(f"the state of a function_policy holds arrays: {reason}") from error
