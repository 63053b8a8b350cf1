"""``python -m rtd3jax.compare RUN_A RUN_B ...``: compare returns of runs in their common cells.

The first run is the baseline. Differences are paired if both runs have at least two equal seeds.
The command prints a Markdown table; with --out DIR it also writes DIR/compare.parquet and
DIR/compare.md.
"""

import argparse
from collections.abc import Sequence

from rtd3jax.cli.common import add_import, exit_status, out_path, replace_unprintable
from rtd3jax.errors import UserError
from rtd3jax.study.comparison import MEASURES, compare_runs, comparison_markdown, differing_settings
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import write_bytes_atomically, write_text_atomically
from rtd3jax.system.imports import import_modules


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status. 0: done. 2: bad input."""
    options = _parser().parse_args(arguments)
    return exit_status(lambda: _run(options), lambda: options.out or options.runs[0])


def _run(options: argparse.Namespace) -> int:
    import_modules(options.imports)
    out = out_path(options.out)
    if out is not None and out.exists() and not out.is_dir():
        raise UserError(f"{out} is a file: --out must name a directory")
    directories = [RunDirectory.open(run) for run in options.runs]
    paths = [str(directory.path.resolve()) for directory in directories]
    names = [_as_text(name) for name in _short_names(paths)]
    measure = MEASURES[options.true_return]
    table = compare_runs(directories, names, measure)
    settings = differing_settings(directories, names, table)
    text = comparison_markdown(table, names, settings, measure)
    print(text, end="")
    if out is not None:
        write_bytes_atomically(out / "compare.parquet", table.to_parquet(index=False))
        write_text_atomically(out / "compare.md", text)
        print(f"\nresults: {out / 'compare.parquet'}, {out / 'compare.md'}")
    return 0


def _as_text(name: str) -> str:
    r"""The name, with escapes such as ``\udcff`` for bytes that are not text.

    Parquet files contain only text, and the escapes keep different names different.
    """
    return name.encode("utf-8", "backslashreplace").decode()


def _short_names(paths: list[str]) -> list[str]:
    """The last parts of each path: as few parts as make all names different."""
    parts = [path.replace("\\", "/").split("/") for path in paths]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return paths


def _parser() -> argparse.ArgumentParser:
    replace_unprintable()
    parser = argparse.ArgumentParser(
        prog="python -m rtd3jax.compare",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="example:\n  python -m rtd3jax.compare runs/before runs/after --out runs/compared",
        allow_abbrev=False,
    )
    parser.add_argument(
        "runs", nargs="+", metavar="RUN", help="run directories, the baseline first"
    )
    parser.add_argument("--out", metavar="DIR", help="also write the table to this directory")
    parser.add_argument(
        "--true-return",
        action="store_true",
        help="compare returns computed from the undisturbed state, not from the reward that the "
        "agent received",
    )
    add_import(parser)
    return parser
