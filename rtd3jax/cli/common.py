"""What the commands have in common: how bad input ends them, and how modules of a user are."""

import argparse
import io
import sys
from collections.abc import Callable
from typing import Any

from rtd3jax.errors import UserError


def show_what_can_be_shown() -> None:
    """Let a terminal that lacks a letter show "?" in its place: output must not end a training."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def exit_status(work: Callable[[], int], place: Callable[[], Any]) -> int:
    """What ``work`` returns; 2, and one line for people, where the input or a file is at fault.

    ``place`` names the directory that a failing file operation most likely meant.
    """
    try:
        return work()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
    except OSError as error:
        # A full disk, say. What was written before is whole, and the same command goes on from it.
        print(f"error: {error.filename or place()}: {error.strerror or error}", file=sys.stderr)
    return 2


def add_import(group: argparse._ActionsContainer) -> None:
    """Give a parser, or a group of one, the option whose values go to `import_modules`."""
    group.add_argument(
        "--import",
        dest="imports",
        action="append",
        default=[],
        metavar="MODULE",
        help="a Python module that registers environments, agents or memories",
    )


def run_parser(
    name: str, description: str | None, example: str, what: str = "a run directory"
) -> argparse.ArgumentParser:
    """The parser of a command on a run directory, with ``run`` and ``--import``."""
    show_what_can_be_shown()
    parser = argparse.ArgumentParser(
        prog=f"python -m rtd3jax.{name}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=f"example:\n  python -m rtd3jax.{name} {example}",
    )
    parser.add_argument("run", help=what)
    add_import(parser)
    return parser
