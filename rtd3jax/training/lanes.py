"""Distributes groups of lanes over cores and devices, in chunks of steps.

A *group* is a set of lanes that one call of a compiled program advances. On a CPU, a group is a
single lane: the results of a lane then do not depend on other lanes, and no product is split over
threads. On an accelerator, a group holds all lanes of a program under ``vmap``, because wider
products cost little there; a lane with a simulator on the host is a group of its own there, too.
Each worker takes the group with the fewest steps, so that five lanes keep two cores equally busy.
"""

import contextlib
import dataclasses
import functools
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.envs.compat.simulated import fleet_of, is_simulated
from rtd3jax.envs.compat.simulator_state import simulator_handles
from rtd3jax.errors import UserError
from rtd3jax.system.interrupts import patient
from rtd3jax.system.jax_settings import Settings, jax_settings, with_settings
from rtd3jax.system.machine import cores
from rtd3jax.training.checkpoint import Checkpoints
from rtd3jax.training.executables import compiled, structure_of
from rtd3jax.training.loop import HEALTHY, Lane, LaneState, Program, revived
from rtd3jax.training.start import Start

CHUNK_SECONDS = 1.0
"""Target wall time of a chunk: the interval of progress, and the delay after Ctrl-C."""

_FIRST_CHUNK = 32
_ENDING = (
    "ending the current steps and writing checkpoints, which takes some seconds; another interrupt "
    "ends the process without them"
)


Executable = tuple[Program, Any]
"""A program, and the structure of its lanes; see `Job.executable`."""


@dataclasses.dataclass(eq=False)
class Job:
    """One lane to be trained.

    Attributes:
        program: the program to compile.
        lane: the seed, the hyperparameters and the environment parameters of the lane.
        cell: key of the cell of the lane; jobs of one cell are adjacent in a list of jobs.
        seed: the seed of the lane within its cell.
        start: trained networks from which training starts; None for new weights.
    """

    program: Program
    lane: Lane
    cell: Any
    seed: int
    start: Start | None = None

    @property
    def key(self) -> tuple[Any, int]:
        """The unique key of the job."""
        return self.cell, self.seed

    @functools.cached_property
    def executable(self) -> Executable:
        """Equal for jobs that share executables, and so can advance together.

        Equal environments can have parameters of different structure, such as other disturbances.
        """
        return self.program, structure_of(self.lane)


@dataclasses.dataclass(eq=False)
class Group:
    """Jobs that advance together, and their progress.

    Attributes:
        jobs: jobs of one program.
        wave: groups of a wave begin before groups of the next wave.
        state: state of all lanes, with a leading axis if there are several; None before the start.
        step: number of steps so far.
        began_at: number of steps of the checkpoint from which it continues.
        returns: learning curves so far, [lanes, K], on the host: a device may be using ``state``.
        metrics: metrics of learning so far, [lanes, K, M], on the host.
        device: the device that holds ``state``; None before the start.
        simulators: handles of the lanes' simulators on the host; empty without simulators.
        lost: whether every lane has failed.
        error: the exception of a group that failed.
    """

    jobs: list[Job]
    wave: int = 0
    state: LaneState | None = None
    step: int = 0
    began_at: int = 0
    returns: np.ndarray | None = None
    metrics: np.ndarray | None = None
    device: Any = None
    simulators: list[int] = dataclasses.field(default_factory=list)
    lost: bool = False
    error: BaseException | None = None

    @property
    def total(self) -> int:
        """Number of steps of the whole training."""
        return self.jobs[0].program.config.total_steps

    @property
    def finished(self) -> bool:
        """Whether the group has ended: all steps done, an error, or every lane lost."""
        return self.error is not None or self.step >= self.total or self.lost

    def lanes(self) -> Iterator[tuple[Job, LaneState]]:
        """Each job with the state of its lane."""
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

    On a CPU, all workers share JAX's single device. Their programs are compiled without Eigen's
    threads, so each core works on another lane, and no product is split (XLA's runtime may still
    move whole kernels between its threads). A second device would compile every program a second
    time. If XLA was configured to show several CPU devices, there is a worker for each.
    """
    first = _default_device()
    if first.platform == "cpu" and len(jax.local_devices(backend="cpu")) == 1:
        return [first] * cores()
    return jax.local_devices(backend=first.platform)


def _default_device() -> Any:
    """JAX's default device, which `jax_default_device` can set."""
    device = jax.config.values["jax_default_device"]
    if isinstance(device, str):  # the name of a platform
        return jax.local_devices(backend=device)[0]
    return device or jax.local_devices()[0]


def advances_alone(job: Job, strategy: str) -> bool:
    """Whether a lane is a group of its own: under ``map``, and with a simulator on the host.

    JAX cannot batch conditions and loops that call a simulator.
    """
    return strategy == "map" or is_simulated(job.program.env)


def make_groups(
    jobs: Sequence[Job],
    strategy: str,
    devices: int,
    at_once: int | None = None,
    checkpoints: Checkpoints | None = None,
) -> list[Group]:
    """Groups of one lane (``map``), or one group per program and device (``vmap``).

    Lanes with simulators also form groups of one lane under ``vmap``.

    With ``checkpoints``, only lanes that have checkpoints at a common step form a group, so a new
    lane does not make the others start from the beginning. Groups that were interrupted at
    different steps are not divided again.

    ``at_once`` limits the number of lanes in memory, under ``vmap`` for each device: groups are
    split, and a group waits until earlier groups have ended.
    """
    most = at_once or len(jobs)
    if all(advances_alone(job, strategy) for job in jobs):
        in_total = most if strategy == "map" else most * devices
        return [Group([job], wave=index // in_total) for index, job in enumerate(jobs)]
    by_executable: dict[Any, list[Job]] = {}
    for job in jobs:
        together = job if advances_alone(job, strategy) else job.executable
        by_executable.setdefault(together, []).append(job)
    steps_of = checkpoints.steps if checkpoints is not None else lambda job: set()
    shares = []
    for members in by_executable.values():
        parts = with_common_steps(members, list(map(steps_of, members)))
        width = -(-len(members) // devices)
        for part in parts:
            count = devices if len(parts) == 1 else -(-len(part) // width)
            shares += [part[start::count] for start in range(min(count, len(part)))]
    chunks = [share[k : k + most] for share in shares for k in range(0, len(share), most)]
    # Lanes that fit in memory alone need not fit together with lanes that wait.
    return [Group(chunk, wave=index // devices) for index, chunk in enumerate(chunks)]


def with_common_steps(members: Sequence[Any], steps: Sequence[set[int]]) -> list[list[Any]]:
    """Divide members into parts, so that the ``steps`` of all members of a part have one in common.

    Each part has the step that most of the remaining members have in common, and of several such
    steps the latest; the last part has the members without steps.
    """
    parts, new = [], [member for member, own in zip(members, steps, strict=True) if not own]
    left = [(member, own) for member, own in zip(members, steps, strict=True) if own]
    while left:
        each = [step for _, own in left for step in own]
        common = max(each, key=lambda step: (each.count(step), step))
        parts.append([member for member, own in left if common in own])
        left = [(member, own) for member, own in left if common not in own]
    return [*parts, new] if new else parts


def advance_groups(
    groups: Sequence[Group],
    on_chunk: Callable[[Group], None],
    checkpoints: Checkpoints | None = None,
    devices: Sequence[Any] | None = None,
) -> None:
    """Advance every group to its end, calling ``on_chunk`` in this thread after each chunk.

    If a group raises an error, the group keeps it, and the other groups continue. After an
    interrupt, the workers finish their current chunks, and the interrupt is raised again. With
    ``checkpoints``, groups continue from their checkpoints, and write new ones at intervals; at the
    end or after an interrupt, each group whose ``state`` is not None has one at its last step. If
    another interrupt ends the wait for the workers, their groups keep the checkpoints they had.
    If a checkpoint cannot be written then, the others are written before the error is raised.
    ``devices`` has a device for each worker, by default those of `workers`.
    """
    pool, settings = _Pool(groups), jax_settings()
    threads = [
        threading.Thread(target=_work, args=(pool, device, checkpoints, settings), daemon=True)
        for device in (workers() if devices is None else devices)[: max(1, len(groups))]
    ]
    try:
        with _simulators_of(groups):
            for thread in threads:
                thread.start()
            try:
                for group in pool.events():
                    on_chunk(group)
            finally:
                with patient(_ENDING):
                    pool.stop()
                    for thread in threads:
                        thread.join()
    finally:
        if checkpoints is not None:
            with patient(_ENDING):
                pool.stop()  # an interrupt may have come before the first call
                given_back = (group for group in groups if not pool.is_held(group))
                # A group that has ended, but is not recorded yet, still has its state.
                kept = (g for g in given_back if g.state is not None and g.error is None)
                checkpoints.save_all(kept)


@contextlib.contextmanager
def _simulators_of(groups: Sequence[Group]) -> Iterator[None]:
    """Close the simulators of the groups at the end, but none of another training."""
    fleets = [(group, fleet_of(group.jobs[0].program.env)) for group in groups]
    with contextlib.ExitStack() as stack:
        for played in {id(fleet): fleet for _, fleet in fleets if fleet is not None}.values():
            stack.enter_context(played.in_use())
        try:
            yield
        finally:
            for group, fleet in fleets:
                if fleet is not None:
                    fleet.drop(group.simulators)


class _Pool:
    """The groups that workers share; every method is thread-safe."""

    def __init__(self, groups: Sequence[Group]):
        self._idle = [group for group in groups if not group.finished]
        self._held: list[Group] = []
        """The groups that workers advance."""
        cells = list(dict.fromkeys(id(group.jobs[0].cell) for group in groups))
        self._rank = {
            id(group): (group.wave, cells.index(id(group.jobs[0].cell))) for group in groups
        }
        self._events: list[Group] = []
        self._unhandled: list[Group] = []
        """Groups that have ended and are not recorded yet: their states are still in memory."""
        self._stopped = False
        self._changed = threading.Condition()

    def take(self, device: Any) -> Group | None:
        """The idle group with the fewest steps; None if this worker will get no more groups.

        A group whose state is on another device is only taken while that device is busy: to move
        it takes time, and memory for a second state.
        """
        with self._changed:
            while (group := self._next(device)) is None:
                if self._stopped or not (self._idle or self._held):
                    return None
                self._changed.wait()
            self._idle.remove(group)
            self._held.append(group)
            group.device = device
            return group

    def is_held(self, group: Group) -> bool:
        """Whether a worker advances the group: its state is then in use, and may be gone.

        After `stop`, no worker takes another group.
        """
        with self._changed:
            return group in self._held

    def _next(self, device: Any) -> Group | None:
        """The group to advance next on the device; None if there is none yet."""
        here = (None, device)
        busy = [held.device for held in self._held]
        ready = [g for g in self._idle if g.device in here or g.device in busy]
        if not ready or self._stopped:
            return None
        # One cell after the other, so that results come early and few replays are in memory;
        # within a cell, the group with the fewest steps.
        group = min(ready, key=lambda g: (g.device not in here, self._rank[id(g)], g.step))
        # Recording takes a while, and the memory is enough for one wave.
        if group.state is None and any(ended.wave < group.wave for ended in self._unhandled):
            return None
        return group

    def give_back(self, group: Group) -> None:
        with self._changed:
            self._held.remove(group)
            (self._unhandled if group.finished else self._idle).append(group)
            self._events.append(group)
            self._changed.notify_all()

    def events(self) -> Iterator[Group]:
        """Yield a group after each of its chunks, until all groups have ended."""
        while True:
            with self._changed:
                while not self._events:
                    if not self._idle and not self._held:
                        return
                    # With a timeout, so that an interrupt reaches the main thread.
                    self._changed.wait(timeout=0.2)
                group = self._events.pop(0)
            yield group
            with self._changed:
                if group in self._unhandled and group not in self._events:
                    self._unhandled.remove(group)
                    self._changed.notify_all()

    def stop(self) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify_all()


def _work(
    pool: _Pool, device: jax.Device, checkpoints: Checkpoints | None, settings: Settings
) -> None:
    """The worker of a device."""
    # jax_debug_nans must be off: points of curves that are not reached yet are NaN.
    with with_settings(settings), jax.debug_nans(False):
        _train(pool, device, checkpoints)


def _train(pool: _Pool, device: jax.Device, checkpoints: Checkpoints | None) -> None:
    """Run chunks of the group with the fewest steps, as long as there is a group."""
    rates: dict[Any, float] = {}
    while (group := pool.take(device)) is not None:
        try:
            if checkpoints is not None and group.state is None:
                _restore(group, checkpoints, device)
            if not group.finished:
                _chunk(group, device, rates)
            if checkpoints is not None and not group.finished and checkpoints.is_due(group):
                _save(group, checkpoints)
        except BaseException as error:  # the group keeps the error; the others continue
            group.error = error
        pool.give_back(group)


def _save(group: Group, checkpoints: Checkpoints) -> None:
    """Write checkpoints of the group; a full disk does not end the training."""
    try:
        checkpoints.save(group)
    except UserError as error:
        warnings.warn(f"{error}; the training continues, and tries again later", stacklevel=2)


def _host(device: jax.Device) -> jax.Device:
    """The device on which the states of lanes are combined.

    An accelerator has memory for the state of a group, but not also for its parts.
    """
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX_PLATFORMS excludes it
        return device


def _restore(group: Group, checkpoints: Checkpoints, device: jax.Device) -> None:
    with jax.default_device(_host(device)):
        found = checkpoints.restore(group.jobs)
        if found is None:
            return
        states, step = found
        states = [
            revived(job.program, job.lane, s, step)
            for job, s in zip(group.jobs, states, strict=True)
        ]
        state = _together(states)
        group.began_at = step
        _advanced(group, state, step)
        checkpoints.note(group, step)


def _together(trees: Sequence[Any]) -> Any:
    """The tree of a group, from the trees of its lanes; several lanes get a leading axis."""
    if len(trees) == 1:
        return trees[0]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def _advanced(group: Group, state: LaneState, step: int) -> None:
    group.returns = np.atleast_2d(np.asarray(state.returns))
    metrics = np.asarray(state.metrics.curves)
    group.metrics = metrics if metrics.ndim == 3 else metrics[None]
    group.simulators = simulator_handles(state.env_state)
    lost = bool(np.all(np.asarray(state.failure) != HEALTHY))
    # The main thread may read at any time: a group that has ended has its last state.
    group.state, group.step, group.lost = state, step, lost


def stacked(lanes: Sequence[Lane], device: jax.Device) -> Lane:
    """The lanes on a device; several lanes get a leading axis."""
    return jax.device_put(_together(lanes), device)


def _chunk(group: Group, device: jax.Device, rates: dict[Any, float]) -> None:
    program, width = group.jobs[0].program, len(group.jobs)
    lane = stacked([job.lane for job in group.jobs], device)
    init, advance = compiled(program, lane, width > 1, device)
    state = _with_start(group, init(lane), device) if group.state is None else group.state
    state = jax.device_put(state, device)
    executable = group.jobs[0].executable
    rate = rates.get((executable, width))
    steps = _FIRST_CHUNK if rate is None else max(1, int(rate * CHUNK_SECONDS))
    # Steps before learning starts are fast: a chunk across this step would take far too long.
    warm_up = program.config.learning_starts
    stop = min(group.step + steps, group.total)
    if group.step < warm_up:
        stop = min(warm_up, group.total)
    environments = program.config.environments
    stop = -(-stop // environments) * environments  # all environments step together
    began = time.perf_counter()
    state = advance(lane, state, jnp.int32(group.step), jnp.int32(stop))
    jax.block_until_ready(state)
    seconds = time.perf_counter() - began
    if group.step >= warm_up:
        rates[executable, width] = (stop - group.step) / seconds
    _advanced(group, state, stop)


def _with_start(group: Group, state: LaneState, device: jax.Device) -> LaneState:
    """The group's new ``state``, in which each lane gets the networks from which it starts."""
    if all(job.start is None for job in group.jobs):
        return state
    with jax.default_device(_host(device)):
        fresh = dataclasses.replace(group, state=jax.device_put(state, _host(device)))
        del state
        return _together(
            [
                own if job.start is None else job.start.begin(job.program, job.lane, own)
                for job, own in fresh.lanes()
            ]
        )
