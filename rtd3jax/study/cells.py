"""The cells of a study: configurations under a disturbance, and the jobs of their lanes."""

import dataclasses
import itertools
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from rtd3jax.config import Config
from rtd3jax.envs.registry import make
from rtd3jax.errors import UserError
from rtd3jax.training.jobs import Job, make_jobs
from rtd3jax.training.loop import static_part


@dataclasses.dataclass(frozen=True)
class Grid:
    """All combinations of one environment, disturbances, algorithms and history lengths."""

    env: str
    disturbances: tuple[str, ...]
    algorithms: tuple[str, ...]
    history_lengths: tuple[int, ...] = (10,)
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Fields of the configuration that differ from the defaults."""
    own_settings: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    """Fields in which an algorithm differs from ``settings``, by the algorithm's name."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """One configuration under one disturbance; its seeds are its lanes."""

    env: str
    disturbance: str
    config: Config

    @property
    def key(self) -> dict[str, Any]:
        """The columns that identify the cell in tables."""
        return {
            "env": self.env,
            "disturbance": self.disturbance,
            "algorithm": self.config.algorithm,
            "history_length": self.config.history_length,
        }

    @property
    def words(self) -> str:
        """The cell in a few words, for messages: ``"rover ar1-slip h-td3 l=10"``."""
        return f"{self.env} {self.disturbance} {self.config.words}"

    def make_env(self) -> Any:
        """The cell's environment."""
        return make(self.env, self.disturbance)

    def to_dict(self) -> dict[str, Any]:
        """The fields as in config.json."""
        return {"env": self.env, "disturbance": self.disturbance, **self.config.to_dict()}

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> "Cell":
        """The cell that `to_dict` wrote."""
        config = {name: value for name, value in fields.items() if name not in _OWN_FIELDS}
        return cls(fields["env"], fields["disturbance"], Config.from_dict(config))


_OWN_FIELDS = ("env", "disturbance")


def make_cells(grids: Iterable[Grid], overrides: dict[str, Any]) -> list[Cell]:
    """The distinct cells of ``grids``, in order; ``overrides`` are fields of all configurations.

    Raises:
        UserError: when there are no cells, or a configuration is impossible.
    """
    cells: dict[Cell, None] = {}
    with warnings.catch_warnings():
        # Several lengths only apply to agents with windows; td3 occurs once.
        warnings.filterwarnings("ignore", message="history_length=")
        for grid in grids:
            combinations = itertools.product(
                grid.disturbances, grid.algorithms, grid.history_lengths
            )
            for disturbance, algorithm, length in combinations:
                own = grid.own_settings.get(algorithm, {})
                settings = {**grid.settings, **own, **overrides}
                config = Config(algorithm=algorithm, history_length=length, **settings)
                cells[Cell(grid.env, disturbance, config)] = None
    if not cells:
        raise UserError("the sweep has no cells: every list needs at least one entry")
    return list(cells)


def cell_jobs(
    cells: Sequence[Cell], seeds: Sequence[int], strategy: str, stages: Sequence[int] = ()
) -> list[Job]:
    """A job for each cell and seed, with key ``(cell, seed)``.

    Side by side (``vmap``), cells of an environment that only differ in history length and in
    traced fields share the program of the longest window: there, a wider matrix product costs
    almost nothing more. One by one (``map``), each history length has a program of its own.

    Args:
        cells: the cells of the study.
        seeds: the seeds of each cell.
        strategy: ``map`` or ``vmap``.
        stages: number of cells before each addition of cells to the study. A longer window that is
            added later does not change the program of earlier cells.
    """
    windows = _windows(cells, stages) if strategy == "vmap" else [None] * len(cells)
    return [
        job
        for cell, window in zip(cells, windows, strict=True)
        for job in make_jobs(cell.make_env(), cell.config, seeds, cell=cell, window=window)
    ]


def _windows(cells: Sequence[Cell], stages: Sequence[int]) -> list[int]:
    """For each cell, the longest window of the cells up to its stage that can share its program."""
    longest: dict[Any, int] = {}
    found: list[int] = []
    for end in (*stages, len(cells)):
        stage = cells[len(found) : end]
        programs = [(cell.env, static_part(cell.config, window=1)) for cell in stage]
        for cell, program in zip(stage, programs, strict=True):
            longest[program] = max(longest.get(program, 0), cell.config.window_tokens)
        found += [longest[program] for program in programs]
    return found


def bar_labels(jobs: Iterable[Job]) -> Callable[[Job], str]:
    """A function that names a job on the bar, with its environment if ``jobs`` have several."""
    if len({job.cell.env for job in jobs}) > 1:
        return lambda job: job.cell.words
    return lambda job: f"{job.cell.config.words} {job.cell.disturbance}"
