"""Equality of environments by value, and strongly typed states, for compiled programs."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike


def strong(tree: object) -> Any:
    """Return the tree with every leaf a strongly typed array of the dtype it already has.

    A Python number in a state is weakly typed, while the state that a step returns often has
    strong types. JAX's loops then trace twice, or refuse their carry.
    """

    def convert(leaf: ArrayLike) -> jax.Array:
        array = jnp.asarray(leaf)
        return jax.lax.convert_element_type(array, array.dtype)

    return jax.tree.map(convert, tree)


class ValueIdentity:
    """Mixin, placed before ``Environment``: equal static options make equal environments.

    An environment is a static argument of compiled programs, so equal environments share a
    program. The numeric parameters are in ``params`` and do not matter for equality. gymnax's
    ``step`` and ``reset`` read ``default_params`` inside the compiled program, which would then
    contain the numbers of the environment that was traced first. This class reads
    ``default_params`` outside the compiled program, at every call.
    """

    def identity(self) -> tuple:
        """The hashable static options that, with the type, distinguish environments."""
        return ()

    def _identity(self) -> tuple:
        return (type(self), getattr(self, "transition_gradients_enabled", False), self.identity())

    def __eq__(self, other: object) -> bool:
        """Whether both have the same type and the same static options."""
        if not isinstance(other, ValueIdentity):
            return NotImplemented
        return self._identity() == other._identity()

    def __hash__(self) -> int:
        """Hash of the type and the static options."""
        return hash(self._identity())

    def step(
        self, key: jax.Array, state: object, action: ArrayLike, params: object = None
    ) -> tuple:
        """One step with automatic reset; None for ``params`` means ``default_params``."""
        params = self.default_params if params is None else params  # type: ignore[attr-defined]
        return super().step(key, state, action, params)  # type: ignore[misc]

    def reset(self, key: jax.Array, params: object = None) -> tuple:
        """Start an episode; None for ``params`` means ``default_params``."""
        params = self.default_params if params is None else params  # type: ignore[attr-defined]
        return super().reset(key, params)  # type: ignore[misc]


@functools.cache
def with_identity(mixin: type, base: type) -> type:
    """The subclass of ``mixin`` and ``base``: the same class at every call."""
    return type(base.__name__, (mixin, base), {"__doc__": base.__doc__})
