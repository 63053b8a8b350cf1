"""``python -m rtd3jax.report RUN``: the page of a run directory, one HTML file without a network.

A sweep writes it too; this command writes it again, from another version or for an older run.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rtd3jax.errors import UserError
from rtd3jax.study.report.page import NAME, write_page
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.worlds import import_worlds


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit status: 0 done, 2 bad input."""
    options = _parser().parse_args(arguments)
    try:
        for module in options.imports:
            import_worlds(module)
        directory = RunDirectory.open(options.run)
        out = None if options.out is None else Path(options.out)
        path = write_page(directory, out, playback=options.playback)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {error.filename or options.run}: {error.strerror}", file=sys.stderr)
        return 2
    print(f"{path}: {path.stat().st_size / 2**20:.1f} MiB")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m rtd3jax.report",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="example:\n  python -m rtd3jax.report runs/quick",
    )
    parser.add_argument("run", help="a run directory")
    parser.add_argument("--out", metavar="FILE", help=f"the page [RUN/{NAME}]")
    parser.add_argument(
        "--no-playback", dest="playback", action="store_false", help="no episodes in the page"
    )
    parser.add_argument(
        "--import",
        dest="imports",
        action="append",
        default=[],
        metavar="MODULE",
        help="a Python module that registers worlds (rtd3jax.register)",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
