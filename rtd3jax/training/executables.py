"""Compiles the programs of lanes, each once for equal programs, and keeps the executables."""

import contextlib
import gc
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp

from rtd3jax.system.jax_settings import jax_settings
from rtd3jax.system.program_cache import make_room, on_full
from rtd3jax.training.lane import Lane
from rtd3jax.training.loop import Program

_COPIES = 3
"""Number of programs that differ only in the environment object, at which a warning is given."""


def _warn_of_copies(program: Program) -> None:
    """Warn once if each training uses a new environment object."""
    kind = type(program.env)

    def rest(program: Program) -> tuple[object, ...]:
        return program.config, program.observation_size, program.action_shape

    copies = {
        id(other.env)
        for other, *_ in _programs
        if type(other.env) is kind and rest(other) == rest(program)
    }
    if kind.__eq__ is object.__eq__ and len(copies) + 1 == _COPIES:
        warnings.warn(
            f"{_COPIES} programs of {kind.__name__} differ only in the environment object; each "
            "needs its own compilation and about 100 MiB: use one object, or inherit from "
            "rtd.ValueIdentity, which defines when two objects are equal",
            stacklevel=2,
        )


class _Compiled:
    """The executables of one program; the first worker that needs them compiles them."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.executables: tuple[Any, Any] | None = None


_programs: dict[Any, _Compiled] = {}
_programs_lock = threading.Lock()


@on_full
def _remove_programs() -> None:
    """Remove all programs. A worker keeps the program that it is running; others compile again."""
    with _programs_lock:
        _programs.clear()


def compiled(program: Program, lane: Lane, batched: bool, device: jax.Device) -> tuple[Any, Any]:
    """``init`` and ``advance``, compiled once for equal programs."""
    key = (program, structure_of(lane), batched, device, jax_settings())
    if key not in _programs:
        make_room()
    with _programs_lock:
        if key not in _programs:
            _warn_of_copies(program)
        entry = _programs.setdefault(key, _Compiled())
    with entry.lock:
        if entry.executables is None:
            entry.executables = _compile(program, lane, batched, device)
        return entry.executables


def _compile(program: Program, lane: Lane, batched: bool, device: jax.Device) -> tuple[Any, Any]:
    init, advance = program.init, program.advance
    options = {}
    if batched:
        init = jax.vmap(init)
        advance = jax.vmap(advance, in_axes=(0, 0, None, None))
    elif device.platform == "cpu":
        options = {"xla_cpu_multi_thread_eigen": False}
    begin = jax.jit(init, compiler_options=options)
    go_on = jax.jit(advance, donate_argnums=1, compiler_options=options)
    with ThreadPoolExecutor(1) as helper, _no_collection():
        state, step = begin.eval_shape(lane), jax.ShapeDtypeStruct((), jnp.int32)
        # The small program is compiled, or read from the cache, during the trace of the large one.
        first = helper.submit(begin.lower(lane).compile)
        second = go_on.lower(lane, state, step, step).compile()
        return first.result(), second


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """A context without garbage collection, which would take a tenth of the time of a trace."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def structure_of(lane: Lane) -> Any:
    """The part of a lane in which two lanes with the same executable must be equal."""
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(lane))
    return jax.tree.structure(lane), shapes
