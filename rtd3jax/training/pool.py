"""The groups that the workers of a training share.

Workers take one cell after the other, and within a cell the group with the fewest steps, so that
five lanes keep two cores equally busy.
"""

import threading
from collections.abc import Iterator, Sequence
from typing import Any

from rtd3jax.training.groups import Group


class Pool:
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
        """The idle group to advance next; None if this worker will get no more groups.

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
