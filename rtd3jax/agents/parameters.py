"""Parameters of a Flax module whose `initial` draws all of them from one key."""

from typing import Any, Protocol

import jax


class _DrawsAll(Protocol):
    """A bound Flax module with `initial`."""

    def initial(self, key: jax.Array) -> dict[str, Any]: ...
    def param(self, name: str, init_fn: Any) -> Any: ...
    def has_variable(self, col: str, name: str) -> bool: ...
    def get_variable(self, col: str, name: str) -> Any: ...


def own_parameters(module: _DrawsAll, names: tuple[str, ...]) -> dict[str, Any]:
    """The parameters ``names`` of ``module``; `module.initial` draws them if it has none yet.

    Existing parameters are read directly, because Flax's `param` traces `initial` at each use of a
    module to compare shapes, which takes a tenth of the time to trace a training program.
    """

    def read_or_draw(name: str) -> Any:
        if module.has_variable("params", name):
            return module.get_variable("params", name)
        return module.param(name, lambda key: module.initial(key)[name])

    return {name: read_or_draw(name) for name in names}
