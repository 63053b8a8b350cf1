"""Estimates the time of a study by running some of its programs for a second each.

A count of operations does not take into account this machine and its load. So some programs of the
study are compiled and timed on all workers that the study will keep busy; the times of other
programs are interpolated by their operations.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.config import Config
from rtd3jax.study.memory_plan import lanes_in_total
from rtd3jax.system.interrupts import patient
from rtd3jax.system.jax_settings import jax_settings, with_settings
from rtd3jax.training.devices import workers
from rtd3jax.training.executables import compiled
from rtd3jax.training.grouping import advances_alone
from rtd3jax.training.jobs import Executable, Job
from rtd3jax.training.lanes import stacked

MOST_PROGRAMS = 4
"""Maximum number of programs that are timed, because each must be compiled."""
_SECONDS = 1.0


def study_seconds(
    jobs: Sequence[Job],
    strategy: str,
    operations: Callable[[Config], float],
    say: Callable[[str], None] = lambda line: None,
    at_once: int | None = None,
) -> float:
    """Seconds that the jobs need with all workers, without compilation.

    Args:
        jobs: the jobs, one for each lane.
        strategy: with ``map``, a lane is trained by one worker at a time; with ``vmap``, a worker
            trains its share of a program's lanes together, but lanes with simulators one by one.
        operations: returns the operations of a configuration per environment step, by which times
            are interpolated.
        say: receives a line before each measurement.
        at_once: number of lanes that fit in memory, under ``vmap`` for each device; all by default.
    """
    devices, most = len(workers()), at_once or len(jobs)
    # Lanes beyond these are not allocated, and workers beyond these have no lane.
    busy = min(devices, len(jobs), lanes_in_total(most, strategy, devices))
    lanes: dict[Executable, list[Job]] = {}
    for job in jobs:
        lanes.setdefault(job.executable, []).append(job)
    executables = sorted(lanes, key=lambda executable: operations(executable[0].config))
    count = min(MOST_PROGRAMS, len(executables))
    places = sorted({round(k * (len(executables) - 1) / max(1, count - 1)) for k in range(count)})
    timed: dict[Executable, float] = {}
    for number, place in enumerate(places, 1):
        own = lanes[executables[place]]
        config = own[0].program.config
        say(f"timing {number} of {len(places)}: {config.words}")
        width = 1 if advances_alone(own[0], strategy) else _width(own, devices, most)
        # As many lanes as the study will train at once: repeated ones stand for other programs.
        timed[executables[place]] = group_seconds([own[k % len(own)] for k in range(busy * width)])
    whole = _filled_in(executables, timed, operations)
    alone, together = [0.0], 0.0
    for executable in executables:
        own, seconds = lanes[executable], whole[executable]
        if advances_alone(own[0], strategy):
            alone += [seconds] * len(own)
        else:
            together += seconds * -(-len(own) // (devices * _width(own, devices, most)))
    # Workers share these lanes, but a lane never has more than one worker.
    return together + max(sum(alone) / busy, max(alone))


def _width(own: Sequence[Job], devices: int, most: int) -> int:
    """Number of a program's lanes that a device advances together."""
    return min(-(-len(own) // devices), most)


def group_seconds(jobs: Sequence[Job]) -> float:
    """Seconds of the workers for these lanes of one program, which they share and train at once.

    With fewer lanes than workers, the other workers are idle.
    """
    program = jobs[0].program
    steps, evaluations = zip(*_measured(jobs), strict=True)
    learning = max(0, program.config.total_steps - program.config.learning_starts)
    return float(np.mean(steps)) * learning + float(np.mean(evaluations)) * program.evaluations


def _measured(jobs: Sequence[Job]) -> list[tuple[float, float]]:
    """For each worker with a lane, the seconds of a step with updates, and of an evaluation."""
    devices = workers()[: len(jobs)]
    together, settings = threading.Barrier(len(devices)), jax_settings()
    found: dict[int, tuple[float, float]] = {}
    errors: list[BaseException] = []

    def work(number: int, device: jax.Device) -> None:
        try:
            with with_settings(settings), jax.debug_nans(False):
                found[number] = _timed(jobs[number :: len(devices)], device, together)
        except BaseException as error:
            errors.append(error)
            together.abort()

    threads = [
        threading.Thread(target=work, args=(number, device), daemon=True)
        for number, device in enumerate(devices)
    ]
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        # After an interrupt: a process that ends while its threads are inside XLA aborts.
        with patient("the measurement ends after the program that is compiled now"):
            together.abort()
            for thread in threads:
                if thread.ident is not None:  # it was started
                    thread.join()
    if errors:
        raise next(
            (e for e in errors if not isinstance(e, threading.BrokenBarrierError)), errors[0]
        )
    return [found[number] for number in range(len(devices))]


def _timed(
    jobs: Sequence[Job], device: jax.Device, together: threading.Barrier
) -> tuple[float, float]:
    program, config = jobs[0].program, jobs[0].program.config
    lane = stacked([job.lane for job in jobs], device)
    init, advance = compiled(program, lane, len(jobs) > 1, device)
    state = init(lane)

    def seconds(start: int, stop: int) -> float:
        nonlocal state
        began = time.perf_counter()
        state = advance(lane, state, jnp.int32(start), jnp.int32(stop))
        jax.block_until_ready(state)
        return time.perf_counter() - began

    # The replay only holds zeros, which take as long as other transitions. A block has at least the
    # steps of one actor update.
    together_at = config.environments  # steps are counted over all environments
    start = config.first_learning_step * together_at
    block = max(config.update_every, together_at) * config.policy_delay
    seconds(start, start + block)
    together.wait()
    done, spent = 0, 0.0
    while spent < _SECONDS and not together.broken:
        # These steps lie between two evaluations, which are timed separately.
        first = start + (-start) % config.eval_every
        length = min(block, max(together_at, config.eval_every - together_at))
        spent += seconds(first, first + length)
        done += length
        block *= 2
    if together.broken:  # another worker failed, or the user interrupted
        raise threading.BrokenBarrierError
    step = spent / done
    last = config.eval_every - together_at
    both = seconds(last, config.eval_every)
    return step, max(0.0, both - together_at * step)


def _filled_in(
    executables: Sequence[Executable],
    timed: Mapping[Executable, float],
    operations: Callable[[Config], float],
) -> dict[Executable, float]:
    """The seconds of a lane of every program, interpolated between the timed programs."""

    def work(executable: Executable) -> float:
        return operations(executable[0].config)

    def total_steps(executable: Executable) -> int:
        return executable[0].config.total_steps

    known = sorted(timed, key=work)
    a_step = [timed[one] / total_steps(one) for one in known]
    steps = np.interp(list(map(work, executables)), list(map(work, known)), a_step)
    return {
        one: timed.get(one, float(step) * total_steps(one))
        for one, step in zip(executables, steps, strict=True)
    }
