"""Lanes over cores and devices: who runs which group of lanes, and for how many steps.

A *group* is what one call of a compiled program advances: on a CPU a single lane, so that a lane's
numbers cannot depend on its company and no product is split over threads; on an accelerator as
many lanes as there are, under ``vmap``, because there width is nearly free. Each device has a
worker that takes the group that lags most, so that five lanes keep two cores equally busy.
"""

import contextlib
import dataclasses
import gc
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.envs.compat.simulator import close_simulators
from rtd3jax.system.machine import cores
from rtd3jax.system.program_cache import make_room, on_full
from rtd3jax.training.checkpoint import Checkpoints
from rtd3jax.training.loop import HEALTHY, Lane, LaneState, Program, revived
from rtd3jax.training.start import Start

CHUNK_SECONDS = 1.0
"""Wall time at which a chunk aims: the pace of progress, and the wait after Ctrl-C."""

_FIRST_CHUNK = 32


@dataclasses.dataclass(eq=False)
class Job:
    """One lane to be trained: its program, what is its own, and what it is called.

    Attributes:
        program: what is compiled.
        lane: its seed, hyperparameters and environment parameters.
        cell: what it is a lane of; jobs of one cell stand together in a list of jobs.
        seed: which of the cell's lanes it is.
        start: what was trained before and it goes on from; None for new weights.
    """

    program: Program
    lane: Lane
    cell: Any
    seed: int
    start: Start | None = None

    @property
    def key(self) -> tuple[Any, int]:
        """What tells it from all other jobs."""
        return self.cell, self.seed


@dataclasses.dataclass(eq=False)
class Group:
    """Jobs that advance together, and how far they are.

    Attributes:
        jobs: of one program.
        wave: groups of a wave are begun before those of the next.
        state: of all lanes, with a leading axis where there are several; None before the start.
        step: steps done.
        returns: the curves so far on the host, [lanes, K]: ``state`` may be in use on a device.
        metrics: likewise, of learning: [lanes, K, M].
        lost: whether every lane has failed.
        error: what a failed group raised.
    """

    jobs: list[Job]
    wave: int = 0
    state: LaneState | None = None
    step: int = 0
    returns: np.ndarray | None = None
    metrics: np.ndarray | None = None
    lost: bool = False
    error: BaseException | None = None

    @property
    def total(self) -> int:
        """Steps to be done."""
        return self.jobs[0].program.config.total_steps

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do: done, failed, or every lane lost."""
        return self.error is not None or self.step >= self.total or self.lost

    def lanes(self) -> Iterator[tuple[Job, LaneState]]:
        """Each job with its lane's state."""
        assert self.state is not None
        if len(self.jobs) == 1:
            yield self.jobs[0], self.state
            return
        for index, job in enumerate(self.jobs):
            with jax.debug_nans(False):  # as in `_work`
                state = jax.tree.map(lambda leaf, i=index: leaf[i], self.state)
            yield job, state


def default_strategy() -> str:
    """``map`` on CPUs, ``vmap`` on accelerators."""
    return "map" if _default_device().platform == "cpu" else "vmap"


def workers() -> list[Any]:
    """The device of each worker: one worker per accelerator, or one per CPU core.

    On a CPU all workers share JAX's one device. Their programs are compiled without Eigen's
    threads, so that the cores are shared out by lanes and not within a product (XLA's runtime may
    still move whole kernels between its threads); a second device would only compile everything a
    second time. Where XLA was told to show several CPU devices, each of them has a worker.
    """
    first = _default_device()
    if first.platform == "cpu" and len(jax.local_devices(backend="cpu")) == 1:
        return [first] * cores()
    return jax.local_devices(backend=first.platform)


def _default_device() -> Any:
    """The device that JAX uses where none is named; `jax_default_device` chooses another."""
    return jax.config.values["jax_default_device"] or jax.local_devices()[0]


def make_groups(
    jobs: Sequence[Job],
    strategy: str,
    devices: int,
    at_once: int | None = None,
    checkpoints: Checkpoints | None = None,
) -> list[Group]:
    """Groups of one lane (``map``), or one group per program and device (``vmap``).

    With ``checkpoints``, only lanes that go on from the same step are grouped, so that one that is
    new does not make the others start over.

    With ``at_once``, no more lanes than that are under way together, each device under ``vmap``:
    groups are split, and wait for those before them.
    """
    most = at_once or len(jobs)
    if strategy == "map":
        return [Group([job], wave=index // most) for index, job in enumerate(jobs)]
    by_program: dict[Any, list[Job]] = {}
    for job in jobs:
        step = 0 if checkpoints is None else checkpoints.newest(job)
        by_program.setdefault((job.program, _structure(job.lane), step), []).append(job)
    shares = [
        members[start::devices]
        for members in by_program.values()
        for start in range(min(devices, len(members)))
    ]
    chunks = [share[k : k + most] for share in shares for k in range(0, len(share), most)]
    # What fits one by one need not fit together with what waits beside it.
    return [Group(chunk, wave=index // devices) for index, chunk in enumerate(chunks)]


def advance_groups(
    groups: Sequence[Group],
    on_chunk: Callable[[Group], None],
    checkpoints: Checkpoints | None = None,
    devices: Sequence[Any] | None = None,
) -> None:
    """Advance every group to its end, calling ``on_chunk`` in this thread after each chunk.

    A group that raises keeps its error and does not touch the others. An interrupt stops the
    workers after their current chunks and is raised again. With ``checkpoints``, groups go on from
    where theirs were, write them as they go, and once more when they are interrupted. ``devices``
    has one for each worker, `workers` by default.
    """
    pool = _Pool(groups)
    threads = [
        threading.Thread(target=_work, args=(pool, device, checkpoints), daemon=True)
        for device in (workers() if devices is None else devices)[: max(1, len(groups))]
    ]
    for thread in threads:
        thread.start()
    try:
        for group in pool.events():
            on_chunk(group)
    finally:
        pool.stop()
        for thread in threads:
            thread.join()
        close_simulators()
        if checkpoints is not None:
            for group in groups:
                if group.state is not None and not group.finished:
                    checkpoints.save(group.lanes(), group, group.step)


class _Pool:
    """The groups that workers share; every method is safe to call from any thread."""

    def __init__(self, groups: Sequence[Group]):
        self._idle = [group for group in groups if not group.finished]
        self._busy = 0
        cells = list(dict.fromkeys(id(group.jobs[0].cell) for group in groups))
        self._rank = {
            id(group): (group.wave, cells.index(id(group.jobs[0].cell))) for group in groups
        }
        self._events: list[Group] = []
        self._stopped = False
        self._changed = threading.Condition()

    def take(self) -> Group | None:
        """The idle group with the least done; None when there will be none for this worker."""
        with self._changed:
            while not self._idle and self._busy and not self._stopped:
                self._changed.wait()
            if not self._idle or self._stopped:
                return None
            # Cell after cell, so that results come early and few replays are held at once;
            # within a cell the group that lags most.
            group = min(self._idle, key=lambda g: (self._rank[id(g)], g.step))
            self._idle.remove(group)
            self._busy += 1
            return group

    def give_back(self, group: Group) -> None:
        with self._changed:
            self._busy -= 1
            if not group.finished:
                self._idle.append(group)
            self._events.append(group)
            self._changed.notify_all()

    def events(self) -> Iterator[Group]:
        """Groups as their chunks end, until all are finished."""
        while True:
            with self._changed:
                while not self._events:
                    if not self._idle and not self._busy:
                        return
                    # A timeout, so that an interrupt reaches the main thread.
                    self._changed.wait(timeout=0.2)
                group = self._events.pop(0)
            yield group

    def stop(self) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify_all()


def _work(pool: _Pool, device: jax.Device, checkpoints: Checkpoints | None) -> None:
    """A device's worker."""
    # jax_debug_nans would take our own NaN for a fault: points of curves that are not reached yet.
    with jax.debug_nans(False):
        _train(pool, device, checkpoints)


def _train(pool: _Pool, device: jax.Device, checkpoints: Checkpoints | None) -> None:
    """Chunks of the lagging group, as long as there is one."""
    rates: dict[Any, float] = {}
    while (group := pool.take()) is not None:
        try:
            if checkpoints is not None and group.state is None:
                _restore(group, checkpoints)
            if not group.finished:
                _chunk(group, device, rates)
            if checkpoints is not None and not group.finished and checkpoints.is_due(group):
                checkpoints.save(group.lanes(), group, group.step)
        except BaseException as error:  # contained: the others go on
            group.error = error
        pool.give_back(group)


def _restore(group: Group, checkpoints: Checkpoints) -> None:
    found = checkpoints.restore(group.jobs)
    if found is not None:
        states, step = found
        states = [
            revived(job.program, job.lane, s, step)
            for job, s in zip(group.jobs, states, strict=True)
        ]
        single = len(states) == 1
        state = states[0] if single else jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
        _advanced(group, state, step)


def _advanced(group: Group, state: LaneState, step: int) -> None:
    group.returns = np.atleast_2d(np.asarray(state.returns))
    metrics = np.asarray(state.metrics.curves)
    group.metrics = metrics if metrics.ndim == 3 else metrics[None]
    group.lost = bool(np.all(np.asarray(state.failure) != HEALTHY))
    group.state, group.step = state, step


def stacked(lanes: Sequence[Lane], device: jax.Device) -> Lane:
    """The lanes on a device: one as it is, several side by side."""
    one = len(lanes) == 1
    lane = lanes[0] if one else jax.tree.map(lambda *leaves: jnp.stack(leaves), *lanes)
    return jax.device_put(lane, device)


def _chunk(group: Group, device: jax.Device, rates: dict[Any, float]) -> None:
    program, width = group.jobs[0].program, len(group.jobs)
    lane = stacked([job.lane for job in group.jobs], device)
    init, advance = compiled(program, lane, width > 1, device)
    state = _begun(group, init(lane)) if group.state is None else group.state
    state = jax.device_put(state, device)
    rate = rates.get((program, width))
    steps = _FIRST_CHUNK if rate is None else max(1, int(rate * CHUNK_SECONDS))
    # Before learning starts steps are cheap: a chunk that crosses over would be far too long.
    warm_up = program.config.learning_starts
    stop = min(group.step + steps, group.total)
    if group.step < warm_up:
        stop = min(warm_up, group.total)
    environments = program.config.environments
    stop = -(-stop // environments) * environments  # they step together
    began = time.perf_counter()
    state = advance(lane, state, jnp.int32(group.step), jnp.int32(stop))
    jax.block_until_ready(state)
    seconds = time.perf_counter() - began
    if group.step >= warm_up:
        rates[program, width] = (stop - group.step) / seconds
    _advanced(group, state, stop)


def _begun(group: Group, state: LaneState) -> LaneState:
    """The group's new ``state``, of which each lane may go on from what was trained before."""
    if all(job.start is None for job in group.jobs):
        return state
    fresh = dataclasses.replace(group, state=state)
    lanes = [
        own if job.start is None else job.start.begin(job.program, job.lane, own)
        for job, own in fresh.lanes()
    ]
    return lanes[0] if len(lanes) == 1 else jax.tree.map(lambda *x: jnp.stack(x), *lanes)


_COPIES = 3
"""Programs that differ in nothing but the environment's object, from which on a warning says so."""


def _warn_of_copies(program: Program) -> None:
    """Warn, once, where a new environment object is made for each training."""
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
            f"{_COPIES} programs of {kind.__name__} differ only in the environment's object, and "
            "each costs its compilation and some 100 MiB: use one object, or inherit "
            "rtd.ValueIdentity, which says when two are equal",
            stacklevel=2,
        )


class _Compiled:
    """The executables of one program, compiled by whoever needs them first."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.executables: tuple[Any, Any] | None = None


_programs: dict[Any, _Compiled] = {}
_programs_lock = threading.Lock()


@on_full
def _let_go() -> None:
    """Workers that are inside a program keep it; the others compile, or read it from the cache."""
    with _programs_lock:
        _programs.clear()


def compiled(program: Program, lane: Lane, batched: bool, device: jax.Device) -> tuple[Any, Any]:
    """``init`` and ``advance``, compiled once for equal programs."""
    key = (program, _structure(lane), batched, device)
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
        # The small program is compiled, or read from the cache, while the large one is traced.
        first = helper.submit(begin.lower(lane).compile)
        second = go_on.lower(lane, state, step, step).compile()
        return first.result(), second


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Tracing makes many small objects and no garbage; collecting meanwhile takes a tenth of it."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _structure(lane: Lane) -> Any:
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(lane))
    return jax.tree.structure(lane), shapes
