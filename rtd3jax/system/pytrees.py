"""Pytrees of different types that JAX cannot confuse.

`jax.jit` stores its traces by the structure of the arguments. JAX 0.10 to 0.11 compares structures
of registered dataclasses, such as those of ``flax.struct``, by their fields without their types:
the structures of ``A(1.0)`` and ``B(1.0)`` are equal, and only their hashes differ. For one to two
of a hundred pairs of types, both hashes lead to the same entry of the table, and ``B`` silently
runs the program of ``A``. This concerns arguments that may have one of several types: processes and
policies.
"""

import dataclasses
import typing
from collections.abc import Iterable
from typing import Any, Self

import jax
from flax import struct
from jax.tree_util import GetAttrKey, register_pytree_with_keys


@typing.dataclass_transform(field_specifiers=(struct.field,), frozen_default=True)
class TypedNode:
    """Base of frozen dataclasses, as ``flax.struct.PyTreeNode``; JAX compares their types too."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__()
        dataclasses.dataclass(frozen=True, **options)(cls)
        fields = dataclasses.fields(cls)  # type: ignore[arg-type]
        is_leaf = {field.name: field.metadata.get("pytree_node", True) for field in fields}
        leaves = tuple(name for name, leaf in is_leaf.items() if leaf)
        static = tuple(name for name, leaf in is_leaf.items() if not leaf)

        def flatten(node: object) -> tuple[tuple, tuple]:
            return tuple(getattr(node, n) for n in leaves), tuple(getattr(node, n) for n in static)

        def flatten_with_keys(node: object) -> tuple[tuple, tuple]:
            children, options = flatten(node)
            return tuple(zip(map(GetAttrKey, leaves), children, strict=True)), options

        def unflatten(options: tuple, children: Iterable[Any]) -> TypedNode:
            return cls(**dict(zip((*leaves, *static), (*children, *options), strict=True)))

        register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
        # A subclass that also has flax's decorator is not registered a second time.
        cls._flax_dataclass = True  # type: ignore[attr-defined]

    def replace(self, **changes: Any) -> Self:
        """A copy with other values of these fields."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]


def node_types(tree: object) -> tuple[type, ...]:
    """The types of all nodes of ``tree``, for a static argument besides ``tree`` itself."""
    found: list[type] = []
    pending: list[Any] = [jax.tree.structure(tree)]
    while pending:
        structure = pending.pop()
        data = structure.node_data()
        if data is not None:
            found.append(data[0])
            pending += structure.children()
    return tuple(found)
