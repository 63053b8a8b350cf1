"""Advances groups of lanes on cores and devices, in chunks of steps.

Each worker is a thread that takes a group from the pool, advances it by a chunk, and gives it back.
"""

import contextlib
import dataclasses
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.envs.compat.simulated import fleet_of
from rtd3jax.envs.compat.simulator_state import simulator_handles
from rtd3jax.errors import UserError
from rtd3jax.system.interrupts import patient
from rtd3jax.system.jax_settings import Settings, jax_settings, with_settings
from rtd3jax.training.checkpoint import Checkpoints
from rtd3jax.training.devices import workers
from rtd3jax.training.executables import compiled
from rtd3jax.training.groups import Group
from rtd3jax.training.lane import HEALTHY, Lane, LaneState
from rtd3jax.training.pool import Pool
from rtd3jax.training.revival import revived

CHUNK_SECONDS = 1.0
"""Target wall time of a chunk: the interval of progress, and the delay after Ctrl-C."""

_FIRST_CHUNK = 32

_ENDING = (
    "ending the current steps and writing checkpoints, which takes some seconds; another interrupt "
    "ends the process without them"
)


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
    pool, settings = Pool(groups), jax_settings()
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


def _work(
    pool: Pool, device: jax.Device, checkpoints: Checkpoints | None, settings: Settings
) -> None:
    """The worker of a device."""
    # jax_debug_nans must be off: points of curves that are not reached yet are NaN.
    with with_settings(settings), jax.debug_nans(False):
        _train(pool, device, checkpoints)


def _train(pool: Pool, device: jax.Device, checkpoints: Checkpoints | None) -> None:
    """Run a chunk of one group after the other, as long as the pool has a group."""
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


def _host(device: jax.Device) -> jax.Device:
    """The device on which the states of lanes are combined.

    An accelerator has memory for the state of a group, but not also for its parts.
    """
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX_PLATFORMS excludes it
        return device


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


def stacked(lanes: Sequence[Lane], device: jax.Device) -> Lane:
    """The lanes on a device; several lanes get a leading axis."""
    return jax.device_put(_together(lanes), device)


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
