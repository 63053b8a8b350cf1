"""Compares runs in their common cells, with bootstrap intervals."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from rtd3jax.errors import UserError
from rtd3jax.study.plants import differing_plants, plant_name
from rtd3jax.study.results import CELL, is_trained
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.statistics import compare, seed_means, summarise
from rtd3jax.study.summary import markdown_row, number
from rtd3jax.study.tables import current_tables

MEASURES = ("return", "true_return")


def compare_runs(
    directories: Sequence[RunDirectory], names: Sequence[str], measure: str = "return"
) -> pd.DataFrame:
    """A row for each run with a cell, for each cell that the first run shares with another run.

    Args:
        directories: at least two; the first is the baseline.
        names: distinct names of the runs.
        measure: ``return``, or ``true_return``, the return of the undisturbed state.

    The columns are those of `rtd3jax.study.results.CELL`, ``run``, and the fields of
    `rtd3jax.study.statistics.Summary` and `rtd3jax.study.statistics.Comparison` with the first run.
    For the first run itself, the comparison is NaN, with 0 pairs.

    Raises:
        UserError: for too few runs, a repeated run, a run without results, or no common cell.
    """
    if len(directories) < 2:
        raise UserError("compare needs at least two runs, the baseline first")
    places = [directory.path.resolve() for directory in directories]
    for place, directory in enumerate(directories):
        if places[place] in places[:place]:
            raise UserError(f"{directory.path} is given twice: compare it with another run")
    values = [_values(directory, measure) for directory in directories]
    first, *others = values
    rows: list[dict[str, Any]] = []
    for cell in first:
        if not any(cell in other for other in others):
            continue
        for place, (name, of_run) in enumerate(zip(names, values, strict=True)):
            if cell not in of_run:
                continue
            compared = compare({} if place == 0 else first[cell], of_run[cell])
            summary = summarise(list(of_run[cell].values()))
            row = dict(zip(CELL, cell, strict=True))
            rows.append({**row, "run": name, **vars(summary), **vars(compared)})
    if not rows:
        has = "; ".join(
            f"{name} has {_environments(of_run)}"
            for name, of_run in zip(names, values, strict=True)
        )
        raise UserError(
            f"{names[0]} has no finished cell (environment, disturbance, agent and history length) "
            f"in common with another run: {has}"
        )
    return pd.DataFrame(rows)


def differing_settings(
    directories: Sequence[RunDirectory], names: Sequence[str], table: pd.DataFrame
) -> list[str]:
    """A text for each setting, and each plant, in which runs differ in the cells of ``table``.

    A cell is compared with the same cell of the other runs, since cells of one run may have
    different settings.
    """
    wanted = set(table[list(CELL)].itertuples(index=False, name=None))
    found: dict[str, dict[tuple[Any, ...], dict[str, str]]] = {}
    shown = set()
    for name, directory in zip(names, directories, strict=True):
        for cell in directory.cells:
            key = tuple(cell.key[column] for column in CELL)
            if key in wanted:
                shown.add(plant_name(cell))
                for field, value in {
                    **cell.to_dict(),
                    "final episodes": directory.episodes,
                }.items():
                    found.setdefault(field, {}).setdefault(key, {})[name] = str(value)
    plants = [directory.known_plants() for directory in directories]
    first = {name: plant for name, plant in plants[0].items() if name in shown}
    changed = [
        f"plant of {names[0]} (there) and {name} (here): {text}"
        for name, own in zip(names[1:], plants[1:], strict=True)
        for text in differing_plants(first, own)
    ]
    return changed + [
        text
        for field, cells in found.items()
        if field not in CELL
        for text in _differences(field, cells)
    ]


def _differences(field: str, cells: dict[tuple[Any, ...], dict[str, str]]) -> list[str]:
    """A text for each combination of different values that a field of ``cells`` has in runs."""
    alike: dict[tuple[tuple[str, str], ...], list[tuple[Any, ...]]] = {}
    for cell, values in cells.items():
        if len(set(values.values())) > 1:
            alike.setdefault(tuple(values.items()), []).append(cell)
    texts = []
    for combination, own in alike.items():
        agents = dict.fromkeys(cell[CELL.index("algorithm")] for cell in own)
        some = f" ({len(own)} of {len(cells)} cells: {', '.join(agents)})"
        where = some if len(own) < len(cells) else ""
        listed = ", ".join(f"{value} ({run})" for run, value in combination)
        texts.append(f"{field}{where}: {listed}")
    return texts


def comparison_markdown(
    table: pd.DataFrame, names: Sequence[str], settings: Sequence[str], measure: str = "return"
) -> str:
    """The table of `compare_runs` as Markdown, with an explanation and the ``settings``."""
    what = "return" if measure == "return" else "true-state return"
    lines = [
        f"# {what[0].upper()}{what[1:]}s of {len(names)} runs",
        "",
        f"The interquartile mean (IQM) over seeds, the difference of means to {names[0]}, and the "
        f"probability that a random seed is better than one of {names[0]}; each with its 95 % "
        "bootstrap interval. A difference is paired if both runs have at least two equal seeds; "
        "pairs is their number.",
        "",
    ]
    lines += [f"- differs: {line}" for line in settings] + [""] * bool(settings)
    header = ["algorithm", "l", "run", "seeds", "IQM [low, high]", "difference [low, high]"]
    header += ["pairs", "P(better) [low, high]"]
    for (env, disturbance), of_task in table.groupby(["env", "disturbance"], sort=False):
        lines += [f"## {env}, {disturbance}", "", markdown_row(header)]
        lines.append(markdown_row(["---", "---:", "---", *["---:"] * 5]))
        for row in of_task.to_dict("records"):
            lost = f" ({row['failed']} lost)" if row["failed"] else ""
            entries = [row["algorithm"], row["history_length"], row["run"], f"{row['n']}{lost}"]
            entries += [_interval(row, "iqm")]
            if row["run"] == names[0]:
                entries += ["–"] * 3
            else:
                entries += [_interval(row, "difference"), row["pairs"] or "–"]
                entries += [_interval(row, "improvement")]
            lines.append(markdown_row(entries))
        lines.append("")
    for name in names[1:]:
        chances = table.loc[table["run"] == name, "improvement"].dropna()
        if len(chances) > 1:
            lines.append(
                f"{name}: mean probability of improvement over {len(chances)} cells "
                f"{chances.mean():.2f}"
            )
    return "\n".join(lines).rstrip() + "\n"


def _values(directory: RunDirectory, measure: str) -> dict[tuple, dict[int, float]]:
    """The mean final return of each trained seed, by cell."""
    episodes = current_tables(directory)["episodes"]
    lanes = seed_means(episodes[is_trained(episodes)])
    if lanes.empty:
        raise UserError(
            f"{directory.path} has no results yet: --status prints its state, and its sweep "
            "trains what is missing"
        )
    found: dict[tuple, dict[int, float]] = {}
    for *cell, seed, value in lanes[[*CELL, "seed", measure]].itertuples(index=False, name=None):
        found.setdefault(tuple(cell), {})[int(seed)] = float(value)
    return found


def _environments(of_run: Mapping[tuple, Any]) -> str:
    """The environments of a run and their agents, in a few words."""
    environments: dict[str, dict[str, None]] = {}
    for env, disturbance, algorithm, length in of_run:
        agent = f"{algorithm} {length}" if length else algorithm
        environments.setdefault(f"{env} {disturbance}", {})[agent] = None
    return (
        ", ".join(
            f"{environment} ({', '.join(agents)})" for environment, agents in environments.items()
        )
        or "none"
    )


def _interval(row: Mapping[Any, Any], name: str) -> str:
    value, low, high = (row[f"{name}{end}"] for end in ("", "_low", "_high"))
    if not math.isfinite(value):
        return "–"
    text = f"{value:.2f}" if name == "improvement" else number(value)
    if not np.isfinite([low, high]).all():
        return text
    ends = [f"{end:.2f}" if name == "improvement" else number(end) for end in (low, high)]
    return f"{text} [{', '.join(ends)}]"
