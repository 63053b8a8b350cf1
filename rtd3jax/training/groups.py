"""Groups: lanes that one call of a compiled program advances together.

On a CPU, a group is a single lane: the results of a lane then do not depend on other lanes, and no
product is split over threads. On an accelerator, a group holds all lanes of a program under
``vmap``, because wider products cost little there; a lane with a simulator on the host is a group
of its own there, too.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from rtd3jax.training.jobs import Job
from rtd3jax.training.lane import LaneState


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
            with jax.debug_nans(False):  # as in the workers: unreached points of curves are NaN
                state = jax.tree.map(lambda leaf, i=index: leaf[i], self.state)
            yield job, state
