"""What makes an environment safe in compiled programs: equality by value, strong state types."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike


def strong(tree: object) -> Any:
    """Return the tree with every leaf a strongly typed array of the dtype it already has.

    A Python number in a state is weakly typed, and what a step returns often is not. Loops then
    trace twice or refuse their carry.
    """

    def convert(leaf: ArrayLike) -> jax.Array:
        array = jnp.asarray(leaf)
        return jax.lax.convert_element_type(array, array.dtype)

    return jax.tree.map(convert, tree)


class ValueIdentity:
    """Mixin, placed before ``Environment``: equal static options make equal environments.

    An environment is a static argument of compiled programs, so equal ones share a program. The
    numbers live in ``params`` and take no part in equality. gymnax's ``step`` and ``reset`` read
    ``default_params`` inside the compiled program, where an equal environment traced earlier would
    supply its own numbers; here they are read outside, at every call.
    """

    def identity(self) -> tuple:
        """The hashable static options, beside the type, that tell environments apart."""
        return ()

    def _identity(self) -> tuple:
        return (type(self), getattr(self, "transition_gradients_enabled", False), self.identity())

    def __eq__(self, other: object) -> bool:
        """Whether both are of one type and have the same static options."""
        if not isinstance(other, ValueIdentity):
            return NotImplemented
        return self._identity() == other._identity()

    def __hash__(self) -> int:
        """Hash of the type and the static options."""
        return hash(self._identity())

    def step(
        self, key: jax.Array, state: object, action: ArrayLike, params: object = None
    ) -> tuple:
        """One step with automatic reset; ``params`` None means this object's own defaults."""
        params = self.default_params if params is None else params  # type: ignore[attr-defined]
        return super().step(key, state, action, params)  # type: ignore[misc]

    def reset(self, key: jax.Array, params: object = None) -> tuple:
        """Start an episode; ``params`` None means this object's own defaults."""
        params = self.default_params if params is None else params  # type: ignore[attr-defined]
        return super().reset(key, params)  # type: ignore[misc]


@functools.cache
def with_identity(mixin: type, base: type) -> type:
    """The subclass of ``mixin`` and ``base``: one class for each pair, so that types compare."""
    return type(base.__name__, (mixin, base), {"__doc__": base.__doc__})
