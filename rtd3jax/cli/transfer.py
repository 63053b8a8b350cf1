"""``python -m rtd3jax.transfer RUN``: test trained agents under other disturbances.

Writes RUN/transfer.parquet (a row per policy, disturbance and episode), adds the table to the page
of the run, and prints the mean return of each agent. If you repeat the command, it replaces the
table.
"""

import argparse
from collections.abc import Sequence

from rtd3jax.cli.common import exit_status, run_parser
from rtd3jax.study.report.page import NAME, refresh_page
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.transfer import FILE, transfer
from rtd3jax.system.imports import import_modules


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status. 0: done. 2: bad input."""
    options = _parser().parse_args(arguments)
    return exit_status(lambda: _run(options), lambda: options.run)


def _run(options: argparse.Namespace) -> int:
    import_modules(options.imports)
    directory = RunDirectory.open(options.run)
    rows = transfer(directory, options.on, options.episodes)
    page = directory.path / NAME
    refresh_page(directory, complete=not page.exists())
    lanes = ["env", "algorithm", "history_length", "trained_on"]
    # As in `seed_means`: an agent with an episode that is not a number has no mean.
    cells = rows.groupby([*lanes, "tested_on"], sort=False)["return"]
    means = cells.agg(lambda returns: returns.mean(skipna=False)).unstack(sort=False)
    print(means.round(3).to_string())
    print(f"results: {directory.path / FILE}, {page}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = run_parser("transfer", __doc__, "runs/rover --on ar1-slip ar1-slip-fast")
    parser.add_argument(
        "--on",
        nargs="+",
        metavar="ID",
        help="disturbances to test on [all disturbances of the run]",
    )
    parser.add_argument(
        "--episodes", type=int, default=100, help="episodes of each policy and disturbance [100]"
    )
    return parser
