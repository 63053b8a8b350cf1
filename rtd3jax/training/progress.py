"""The progress bar: steps, steps per second, remaining time, and returns."""

import time
from collections.abc import Callable, Sequence

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from rtd3jax.training.groups import Group
from rtd3jax.training.jobs import Job

LONG_SECONDS = 60.0
"""Seconds after which the remark is shown."""


class Progress:
    """A context that shows the bar; call `update` after every chunk.

    ``remark`` is shown once above the bar, if the training takes long.
    """

    def __init__(
        self,
        groups: Sequence[Group],
        label: Callable[[Job], str],
        *,
        enabled: bool = True,
        remark: str = "",
    ):
        self._remark = remark
        self._groups = groups
        self._label = label
        self._began = time.perf_counter()
        self._start = 0
        self._latest: dict[tuple[str, int], float] = {}
        self._bar = Bar(
            TextColumn("{task.percentage:3.0f}%"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[rate]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[returns]}"),
            console=Console(stderr=True),
            disable=not enabled,
        )
        self._total = sum(group.total * len(group.jobs) for group in groups)
        self._task = self._bar.add_task("", total=self._total, rate="compiling", returns="")

    def __enter__(self) -> "Progress":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def update(self, group: Group) -> None:
        """Show that ``group`` has advanced."""
        if self._bar.disable or group.returns is None:
            return
        for index, job in enumerate(group.jobs):
            curve = group.returns[index]
            curve = curve[np.isfinite(curve)]
            if curve.size:
                self._latest[self._label(job), id(job)] = float(curve[-1])
        # Workers read checkpoints when they begin. The steps of a checkpoint took no time here, so
        # they are set directly: an addition by the bar would count for the speed.
        start = sum(group.began_at * len(group.jobs) for group in self._groups)
        self._bar.tasks[self._task].completed += start - self._start
        self._start = start
        done = self._done()
        elapsed = time.perf_counter() - self._began
        if self._remark and elapsed > LONG_SECONDS and done < self._total:
            self._bar.console.print(self._remark, markup=False, highlight=False)
            self._remark = ""
        rate = (done - self._start) / max(elapsed, 1e-9)
        self._bar.update(
            self._task, completed=done, rate=f"{rate:,.0f} steps/s", returns=self._returns()
        )

    def _done(self) -> int:
        return sum(group.step * len(group.jobs) for group in self._groups)

    def _returns(self) -> str:
        by_label: dict[str, list[float]] = {}
        for (label, _), value in self._latest.items():
            by_label.setdefault(label, []).append(value)
        return "  ".join(f"{label} {np.mean(values):.2f}" for label, values in by_label.items())
