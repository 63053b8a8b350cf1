"""``python -m rtd3jax.stress RUN``: test the robustness of trained agents.

Measures returns against the strength of noise, delays, lost readings, slip and changes of the
plant's parameters. Writes RUN/robustness.parquet (a row per policy, stress and value) and pictures,
and adds charts to the page of the run. If you repeat the command, it replaces the table.
"""

import argparse
from collections.abc import Sequence

from rtd3jax.cli.common import exit_status, run_parser
from rtd3jax.study.report.page import NAME, refresh_page
from rtd3jax.study.robustness import FILE, draw_robustness, run_robustness
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.imports import import_modules


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status. 0: done. 2: bad input."""
    options = _parser().parse_args(arguments)
    return exit_status(lambda: _run(options), lambda: options.run)


def _run(options: argparse.Namespace) -> int:
    import_modules(options.imports)
    directory = RunDirectory.open(options.run)
    table = run_robustness(directory, options.stresses, options.episodes)
    pictures = draw_robustness(table, directory.path)
    page = directory.path / NAME
    refresh_page(directory, complete=not page.exists())
    print(f"results: {', '.join(map(str, [directory.path / FILE, *pictures, page]))}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = run_parser("stress", __doc__, "runs/rover --stresses slip noise=0,0.1,0.2")
    parser.add_argument(
        "--stresses",
        nargs="+",
        metavar="NAME",
        help="stresses, each with its default values or as NAME=VALUE,VALUE,... [all]",
    )
    parser.add_argument(
        "--episodes", type=int, default=100, help="episodes of each policy and value [100]"
    )
    return parser
