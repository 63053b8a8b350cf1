"""Writes the table of an experiment, and the facts about its run."""

import argparse
import datetime
import json
import os
import pathlib
import platform
import shutil

import jax
import numpy as np
import pandas as pd

RESULTS = pathlib.Path(__file__).parent / "results"
BENCHMARKS = RESULTS / "benchmarks"
QUICK = pathlib.Path("runs/quick_experiments")


def parse(
    parser: argparse.ArgumentParser,
    arguments: list[str] | None,
    written: tuple[str, ...] = ("out", "run"),
) -> argparse.Namespace:
    """The options. With ``--quick``, nothing is written to the directories of the full run.

    Instead of the defaults of the options ``written``, a quick run has places in `QUICK`, or, for
    ``--run``, in ``--out``. It is an error to name such a default, or a place in the results.
    """
    options = parser.parse_args(arguments)
    for name in written if options.quick else ():
        default, given = parser.get_default(name), getattr(options, name, None)
        if given is None:
            continue
        if given is default:
            within = QUICK if name == "out" else options.out
            is_folder = name == "out" and not default.suffix
            setattr(options, name, within if is_folder else within / default.name)
            continue
        place = given.resolve()
        if place == default.resolve() or place.is_relative_to(RESULTS.resolve()):
            parser.error(f"the results of --quick have no meaning: choose another --{name}")
    return options


def check_steps(parser: argparse.ArgumentParser, options: argparse.Namespace, usual: int) -> None:
    """End the script if trainings of another number of steps would replace rows of the results."""
    if options.steps != usual and options.out.resolve() == RESULTS.resolve():
        parser.error(f"with --steps {options.steps}, choose another --out")


def provenance(**facts: object) -> dict[str, object]:
    """Facts about a run, with versions, device and date."""
    return {
        **facts,
        "date": datetime.date.today().isoformat(),
        "jax": jax.__version__,
        "python": platform.python_version(),
        "device": f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores",
    }


def write_results(
    out: pathlib.Path, name: str, table: pd.DataFrame, markdown: str, facts: dict[str, object]
) -> None:
    """Write ``name``.parquet, ``name``.md and ``name``.json to ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    table.to_parquet(out / f"{name}.parquet", index=False)
    lines = [markdown.rstrip(), "", *(f"- {key}: {value}" for key, value in facts.items())]
    (out / f"{name}.md").write_text("\n".join(lines) + "\n")
    (out / f"{name}.json").write_text(json.dumps(facts, indent=1, default=str) + "\n")


def keep_curves(run: pathlib.Path, out: pathlib.Path, name: str) -> None:
    """Copy the learning curves of the sweep in ``run`` to ``name``_learning_curves.png."""
    drawn = run / "learning_curves.png"
    if drawn.exists():
        shutil.copyfile(drawn, out / f"{name}_learning_curves.png")


def mean_text(values: pd.Series | np.ndarray, digits: int) -> str:
    """The mean of values, and their standard deviation if there are several."""
    spread = f" ± {values.std(ddof=1):.{digits}f}" if len(values) > 1 else ""
    return f"{values.mean():.{digits}f}{spread}"


def seeds_text(count: int, seeds: int) -> str:
    """A remark that only ``count`` of the seeds are there; empty if all are."""
    return "" if count == seeds else f" ({count} of {seeds} seeds)"


def say(text: str, missing: list[str]) -> None:
    """Print the text of a table, and a line for each thing that it lacks."""
    print(text)
    for line in missing:
        print(f"missing: {line}")


def markdown_table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows))
