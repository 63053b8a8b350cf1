"""JAX's settings on which the numbers of a training depend.

A context manager such as ``jax.default_matmul_precision`` only acts in the thread that enters it,
so threads that compile for another thread enter the settings of that thread.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import jax

_CONTEXTS: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "jax_default_matmul_precision": (None, jax.default_matmul_precision),
    "jax_threefry_partitionable": (True, jax.threefry_partitionable),
    "jax_enable_x64": (False, jax.enable_x64),
}
"""The default value and the context manager of each setting."""

Settings = tuple[tuple[str, Any], ...]
"""Names and values of the settings that differ from their defaults."""


def jax_settings() -> Settings:
    """The settings of this thread."""
    found = ((name, getattr(jax.config, name)) for name in _CONTEXTS)
    return tuple((name, value) for name, value in found if value != _CONTEXTS[name][0])


@contextlib.contextmanager
def with_settings(settings: Settings) -> Iterator[None]:
    """A context with the settings of another thread, from its `jax_settings`."""
    given = dict(settings)
    with contextlib.ExitStack() as stack:
        for name, (default, context) in _CONTEXTS.items():
            stack.enter_context(context(given.get(name, default)))
        yield


def random_key(seed: int | jax.Array) -> jax.Array:
    """The key of a seed, for JAX's default generator, even if another one is set.

    Under vmap, the numbers of the generators ``rbg`` and ``unsafe_rbg`` depend on the other lanes.
    """
    return jax.random.key(seed, impl="threefry2x32")
