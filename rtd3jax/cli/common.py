"""Code that the commands share: the exit status for bad input, and common options."""

import argparse
import io
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rtd3jax.errors import UserError
from rtd3jax.system.files import user_path


def replace_unprintable() -> None:
    """Print "?" for a letter that the terminal cannot show, so that no run ends by an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def exit_status(
    work: Callable[[], int],
    place: Callable[[], Any],
    interrupted: Callable[[KeyboardInterrupt], int] = lambda _: 130,
) -> int:
    """Run a command and return its exit status.

    Args:
        work: the command; it returns the status.
        place: returns the path that an error message names when a file operation failed and the
            system named no file.
        interrupted: returns the status after an interrupt, for which a line is printed.

    Returns:
        what ``work`` returns; 2, after one line on stderr, if the input or a file is at fault; what
        ``interrupted`` returns, after an interrupt; 0 if the reader of the output ends before the
        command.
    """
    status = 0
    try:
        status = work()
        sys.stdout.flush()  # else the error of a closed pipe comes at the end of the process
        return status
    except KeyboardInterrupt as interrupt:
        print("interrupted: repeat the command", file=sys.stderr)
        return interrupted(interrupt)
    except BrokenPipeError:  # the reader has ended, such as head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return status
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
    except OSError as error:
        # A full disk, for example. Files that were written before the error are complete, and the
        # same command continues from them.
        print(f"error: {error.filename or place()}: {error.strerror or error}", file=sys.stderr)
    return 2


def out_path(value: str | None) -> Path | None:
    """The path that ``--out`` names, or None; UserError if its value is empty."""
    if value == "":
        raise UserError("--out is empty: name a path, or leave it out")
    return None if value is None else user_path(value)


def add_import(group: argparse._ActionsContainer) -> None:
    """Add ``--import`` to a parser or a group; `import_modules` takes its values."""
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
    """The parser of a command that reads a run directory: it has ``run`` and ``--import``."""
    replace_unprintable()
    parser = argparse.ArgumentParser(
        prog=f"python -m rtd3jax.{name}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=f"example:\n  python -m rtd3jax.{name} {example}",
        allow_abbrev=False,
    )
    parser.add_argument("run", help=what)
    add_import(parser)
    return parser
