"""`Study`: the sweep (``python -m rtd3jax.sweep``) as a Python class.

study = rtd.Study(
    [rtd.Cell("rover", "ar1-slip", rtd.Config(algorithm=name)) for name in ("td3", "h-td3")],
    seeds=range(5),
    out="runs/mine",
)
study.run()
study.tables()["episodes"].groupby("algorithm")["return"].mean()
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from rtd3jax.errors import UserError
from rtd3jax.policies.trained import Policy
from rtd3jax.study.ceilings import ceilings_of
from rtd3jax.study.cells import Cell
from rtd3jax.study.execute import Work, planned_jobs
from rtd3jax.study.figures import final_returns, learning_curves
from rtd3jax.study.loggers import check_loggers
from rtd3jax.study.memory_plan import lanes_at_once, usable_memory
from rtd3jax.study.report.page import write_page
from rtd3jax.study.run import run_study
from rtd3jax.study.rundir import RunDirectory, holds_study
from rtd3jax.study.status import ledger
from rtd3jax.study.tables import current_tables
from rtd3jax.system.files import user_path
from rtd3jax.system.interrupts import terminable
from rtd3jax.system.numbers import check_counts
from rtd3jax.training.arguments import check_checkpoints, check_seeds, check_strategy
from rtd3jax.training.devices import workers


class Study:
    """Cells with the same seeds, in a run directory.

    Args:
        cells: the cells to train, each with an environment, a disturbance and a configuration.
        seeds: the seeds of each cell.
        out: the run directory. An existing study is continued; `run` adds seeds, cells and steps
            that it does not have.
        final_episodes: number of episodes of the evaluation at the end of a lane.

    Raises:
        UserError: when a cell cannot be trained, when tables cannot distinguish two cells, when an
            existing lane of ``out`` would change, or when ``out`` cannot be written.
    """

    def __init__(
        self,
        cells: Iterable[Cell],
        *,
        seeds: Iterable[int] = range(5),
        out: str | os.PathLike,
        final_episodes: int = 20,
    ) -> None:
        check_counts(final_episodes, 0, "final_episodes")
        directory = RunDirectory(
            user_path(out), _distinct(cells), check_seeds(seeds), int(final_episodes)
        )
        directory.plan()
        if not holds_study(directory.path):  # opening a study does not extend it
            # Raises UserError before any file is written.
            planned_jobs(directory, check_strategy(None))
            directory.prepare()
        self._directory = directory

    @property
    def path(self) -> Path:
        """The run directory."""
        return self._directory.path

    def run(
        self,
        *,
        quiet: bool = False,
        page: bool = True,
        log: Sequence[str] = (),
        strategy: str | None = None,
        checkpoint_seconds: float | None = None,
        keep_checkpoints: bool = False,
    ) -> list[str]:
        """Train the lanes that are missing, then write tables, pictures and the page.

        Args:
            quiet: whether to omit the progress bar.
            page: whether to write ``report.html``.
            log: names of trackers: ``tensorboard``, ``wandb``, ``mlflow``.
            strategy: ``map`` or ``vmap``; by default ``map`` on a CPU and ``vmap`` on an
                accelerator.
            checkpoint_seconds: time between checkpoints of a lane; by default five minutes, or
                longer if checkpoints would take more than 2% of the time.
            keep_checkpoints: whether to keep the last checkpoint of a lane that has ended, so that
                it can continue to more steps later.

        Returns:
            A line for each lane that was lost or failed.

        Raises:
            UserError: when a cell cannot be trained, a tracker cannot be opened, not even one lane
                fits in memory, or another process writes to the directory.
            KeyboardInterrupt: after Ctrl-C or SIGTERM, when checkpoints and the results so far are
                written. A program's own handler of SIGTERM stays in force.
        """
        directory, strategy = self._directory, check_strategy(strategy)
        check_loggers(log)
        check_checkpoints(None, checkpoint_seconds)
        directory.plan()
        jobs = planned_jobs(directory, strategy)
        at_once = lanes_at_once(jobs, strategy, len(workers()), usable_memory())
        interval = (checkpoint_seconds, None)
        work = Work(strategy, at_once, interval, quiet=quiet, page=page, keep=keep_checkpoints)
        # So far, a UserError has left the directory as it was.
        if news := directory.prepare():
            print(news)
        with terminable():
            complaints, interrupt = run_study(directory, jobs, work, log=log)
        if interrupt is not None:
            raise interrupt
        return complaints

    def status(self) -> pd.DataFrame:
        """A row per lane: its cell, seed, state and step, and the reason if it was lost."""
        return pd.DataFrame(ledger(self._directory))

    def tables(self) -> dict[str, pd.DataFrame]:
        """The tables ``curves``, ``episodes`` and ``metrics`` of the lanes that have ended.

        Raises:
            UserError: when no lane has ended yet.
        """
        tables = current_tables(self._directory)
        if all(table.empty for table in tables.values()):
            raise UserError(f"{self.path} has no results yet: run() trains its lanes")
        return tables

    def figures(self) -> list[Path]:
        """Draw learning curves and final returns again; return the paths of the figures."""
        tables = self.tables()
        best = ceilings_of(self.path, self._directory.cells, compute=False)
        curves, episodes = tables["curves"], tables["episodes"]
        return [
            *learning_curves(curves, episodes, self.path, best),
            *final_returns(episodes, self.path, best),
        ]

    def report(self) -> Path:
        """Write the page again; return its path."""
        return write_page(self._directory)

    def policy(self, cell: Cell, seed: int) -> Policy:
        """The trained policy of a lane.

        Raises:
            UserError: when the study has no such seed or cell, or has the cell with other
                settings; when the lane has not ended, or was lost.
        """
        if not isinstance(cell, Cell):
            raise UserError(f"a study consists of rtd.Cell, not {type(cell).__name__}")
        self._directory.contents.check_cell(self.path, cell)
        return self._directory.lanes.policy(cell, self._directory.own_seed(seed))


def _distinct(cells: Iterable[Cell]) -> list[Cell]:
    """The cells, if the columns of the tables distinguish them; else UserError."""
    found: dict[tuple[object, ...], Cell] = {}
    for cell in cells:
        if not isinstance(cell, Cell):
            raise UserError(f"a study consists of rtd.Cell, not {type(cell).__name__}")
        key = tuple(cell.key.values())
        if key in found and found[key].to_dict() != cell.to_dict():
            raise UserError(
                f"two cells are both {', '.join(map(str, key))}: tables distinguish cells only by "
                f"{', '.join(cell.key)}; put them in separate studies"
            )
        found[key] = cell
    if not found:
        raise UserError("a study needs at least one cell")
    return list(found.values())
