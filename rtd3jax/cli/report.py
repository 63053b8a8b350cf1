"""``python -m rtd3jax.report RUN``: write the page of a run, an HTML file that needs no network.

A sweep writes this page when it ends. This command writes the page again, for example for a run of
an earlier version.
"""

import argparse
from collections.abc import Sequence

from rtd3jax.cli.common import exit_status, out_path, run_parser
from rtd3jax.study.report.page import NAME, write_page
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.imports import import_modules


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status. 0: done. 2: bad input."""
    options = _parser().parse_args(arguments)
    return exit_status(lambda: _run(options), lambda: options.run)


def _run(options: argparse.Namespace) -> int:
    import_modules(options.imports)
    out = out_path(options.out)
    directory = RunDirectory.open(options.run)
    path = write_page(directory, out, playback=options.playback)
    print(f"{path}: {path.stat().st_size / 2**20:.1f} MiB")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = run_parser("report", __doc__, "runs/quick")
    parser.add_argument("--out", metavar="FILE", help=f"the file to write [RUN/{NAME}]")
    parser.add_argument(
        "--no-playback",
        dest="playback",
        action="store_false",
        help="leave the episodes out of the page",
    )
    return parser
