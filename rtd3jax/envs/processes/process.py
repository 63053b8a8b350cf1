"""Hidden processes: they change a signal from step to step, and are drawn in every episode.

A process is a pytree. Its numeric parameters are leaves: one compiled program serves all of their
values, and can be vmapped over them. Its structural options are static.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from rtd3jax.errors import UserError
from rtd3jax.system.numbers import is_integer
from rtd3jax.system.pytrees import TypedNode


class Process(TypedNode):
    """Base of every process. A signal is a float vector, such as an observation [O]."""

    begins_later: ClassVar[bool] = False
    """Whether the process begins to act at a random step of the episode."""

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> Any:
        """Draw the state for an episode of ``horizon`` steps (may be traced) and signals [size]."""
        raise NotImplementedError

    def step(self, key: jax.Array, state: Any, signal: jax.Array) -> tuple[jax.Array, Any]:
        """The changed signal of this step, and the state for the next step."""
        raise NotImplementedError

    def output_size(self, size: int) -> int:
        """Elements of the output for an input of ``size``; UserError if ``size`` does not fit."""
        return size

    def validate(self) -> None:
        """Raise UserError, naming the parameter, if a parameter that is not traced is invalid."""

    def check_use(self, horizon: int, field: str) -> None:
        """Raise UserError if the process cannot act in a whole episode of ``horizon`` steps.

        ``field`` is the name of the environment's parameter that holds the process.
        """


class NoDisturbance(Process):
    """A process that does not change the signal."""

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> tuple[()]:
        """No state."""
        return ()

    def step(
        self, key: jax.Array, state: tuple[()], signal: jax.Array
    ) -> tuple[jax.Array, tuple[()]]:
        """The signal and the empty state, unchanged."""
        return signal, state


Nothing = NoDisturbance
"""The name of `NoDisturbance` in earlier versions."""


class Composition(Process):
    """Several processes in one; the base of `Chain`, `Sum` and `Mixture`."""

    processes: tuple[Process, ...] = ()

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> Any:
        """The members' states as a tuple; every member has the same signal and its own stream."""
        return tuple(
            process.init(jax.random.fold_in(key, index), horizon, size)
            for index, process in enumerate(self.processes)
        )

    def validate(self) -> None:
        """Check that the members are processes, and validate each."""
        name, members = type(self).__name__, self.processes
        if not isinstance(members, tuple | list):
            raise UserError(
                f"{name}: the processes must be a tuple, {name}((process, process, ...)), not "
                f"{members!r}"
            )
        if not members:
            raise UserError(f"{name} has no members: pass processes=(process, process, ...)")
        for process in members:
            if isinstance(process, type):
                raise UserError(
                    f"{name}: {process.__name__} is a class; pass an instance, such as "
                    f"{process.__name__}()"
                )
            if not isinstance(process, Process):
                raise UserError(f"{name}: {process!r} is not a process, such as rtd.Dropout()")
            process.validate()

    def check_use(self, horizon: int, field: str) -> None:
        """Check every member."""
        for process in self.processes:
            process.check_use(horizon, field)


class Chain(Composition):
    """Several processes in sequence, each with its own random stream."""

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> tuple:
        """The tuple of the members' states."""
        states = []
        for index, process in enumerate(self.processes):
            states.append(process.init(jax.random.fold_in(key, index), horizon, size))
            size = process.output_size(size)
        return tuple(states)

    def step(self, key: jax.Array, state: tuple, signal: jax.Array) -> tuple[jax.Array, tuple]:
        """Pass the signal through the members in order."""
        states = []
        for index, (process, inner) in enumerate(zip(self.processes, state, strict=True)):
            signal, inner = process.step(jax.random.fold_in(key, index), inner, signal)
            states.append(inner)
        return signal, tuple(states)

    def output_size(self, size: int) -> int:
        """The size after the last member."""
        for process in self.processes:
            size = process.output_size(size)
        return size


class Sum(Composition):
    """Several processes in parallel: each reads the clean signal, and their offsets are added.

    Each process has its own random stream. In a `Chain`, a process reads the output of the previous
    one; here, no process reads the output of another, so their order does not matter.
    """

    def step(self, key: jax.Array, state: tuple, signal: jax.Array) -> tuple[jax.Array, tuple]:
        """Add every member's offset to the signal."""
        total, states = signal, []
        for index, (process, inner) in enumerate(zip(self.processes, state, strict=True)):
            disturbed, inner = process.step(jax.random.fold_in(key, index), inner, signal)
            total = total + (disturbed - signal)
            states.append(inner)
        return total, tuple(states)

    def output_size(self, size: int) -> int:
        """Unchanged; raises UserError for a member that adds or removes elements."""
        for process in self.processes:
            if process.output_size(size) != size:
                raise UserError(
                    f"Sum: {type(process).__name__} changes the number of elements, so its offset "
                    "is not defined; use a Chain"
                )
        return size


def check_uses(params: object, horizon: int | jax.Array) -> None:
    """Raise UserError if a process in an environment's parameters cannot act in its episodes.

    ``horizon`` is the time limit of an episode, in steps. A traced limit is not checked.
    """
    if isinstance(horizon, jax.core.Tracer) or np.ndim(horizon):
        return
    found = jax.tree_util.tree_leaves_with_path(params, lambda part: isinstance(part, Process))
    for path, process in found:
        if isinstance(process, Process):
            process.check_use(int(horizon), str(getattr(path[-1], "name", "")) if path else "")


def float32(value: ArrayLike) -> jax.Array:
    """A parameter as a strongly typed float32 array, for any type of number."""
    return jnp.asarray(value, jnp.float32)


def require(
    process: object, name: str, low: float = -np.inf, high: float = np.inf, above: float = -np.inf
) -> None:
    """Raise UserError unless field ``name`` is finite, in [low, high] and greater than ``above``.

    Traced values are not checked.
    """
    value = getattr(process, name)
    if isinstance(value, jax.core.Tracer):
        return
    where = f"{type(process).__name__}: {name}={value}"
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{where} is not a number") from None
    if not np.all(np.isfinite(numbers)):
        raise UserError(f"{where} is not finite")
    if np.any(numbers < low):
        raise UserError(f"{where} must be at least {low:g}")
    if np.any(numbers <= above):
        raise UserError(f"{where} must be greater than {above:g}")
    if np.any(numbers > high):
        raise UserError(f"{where} must be at most {high:g}")


def require_whole(process: object, name: str, low: int) -> None:
    """Raise UserError unless field ``name``, which is static, is an integer of at least ``low``."""
    value = getattr(process, name)
    if not is_integer(value):
        raise UserError(
            f"{type(process).__name__}: {name}={value!r} must be a whole number, written without "
            "a decimal point"
        )
    require(process, name, low=low)


def require_size(process: object, size: int, *names: str) -> None:
    """Raise UserError unless each field is one number or an array [size]."""
    for name in names:
        value = getattr(process, name)
        # A list may hold tracers, of which numpy cannot make an array.
        shape = (len(value),) if isinstance(value, list | tuple) else np.shape(value)
        if shape not in ((), (size,)):
            raise UserError(
                f"{type(process).__name__}: {name} of shape {shape} does not fit a signal of "
                f"{size} element{'s' * (size != 1)}; pass one number, or one for each element"
            )


def require_ordered(process: object, low_name: str, high_name: str) -> None:
    """Raise UserError if field ``low_name`` exceeds field ``high_name``."""
    low, high = getattr(process, low_name), getattr(process, high_name)
    if isinstance(low, jax.core.Tracer) or isinstance(high, jax.core.Tracer):
        return
    try:
        exceeds = np.any(np.asarray(low) > np.asarray(high))
    except ValueError:  # numpy cannot broadcast them
        raise UserError(
            f"{type(process).__name__}: {low_name} of shape {np.shape(low)} and {high_name} of "
            f"shape {np.shape(high)} do not fit; pass one number, or one for each element"
        ) from None
    if exceeds:
        raise UserError(
            f"{type(process).__name__}: {low_name}={low} is greater than {high_name}={high}"
        )
