"""The data of a run directory for its page, as JSON values.

Numbers are rounded to five significant digits; infinity and NaN become None. Data that are missing
are left out, and a note gives the reason: the page can also show an unfinished run.
"""

import dataclasses
import json
import math
import re
from collections import Counter, defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from rtd3jax.config import Config
from rtd3jax.errors import UserError
from rtd3jax.study.cells import Cell
from rtd3jax.study.colours import colour_of, ordered
from rtd3jax.study.log import LOG, TASKS, lane_of, read_log, steps_reached
from rtd3jax.study.results import CELL, is_trained, reference_names, rounded_number
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.statistics import Summary, iqm_bands, reference_mean, summarise, thinned
from rtd3jax.study.status import ledger
from rtd3jax.training.checkpoint_files import checkpoint_steps

MEASURES = {"return": "as rewarded", "true_return": "of the true state"}


def study_data(
    directory: RunDirectory,
    tables: Mapping[str, pd.DataFrame],
    lanes: pd.DataFrame,
    notes: list[str],
) -> dict[str, Any]:
    """All data except ceilings, transfer, robustness and playback.

    Missing data add a line to ``notes``. ``tables`` are those of `current_tables`, and ``lanes``
    are the `seed_means` of the episodes.
    """
    curves, episodes, metrics = (tables[name] for name in ("curves", "episodes", "metrics"))
    if curves.empty and not is_trained(lanes).any():
        notes.append("no lane has ended yet")
    log = read_log(directory.path / LOG)
    curves = _with_log(curves, log, directory)
    environments = list(dict.fromkeys((cell.env, cell.disturbance) for cell in directory.cells))
    algorithms = ordered(cell.config.algorithm for cell in directory.cells)
    measures = [m for m in MEASURES if m == "return" or _differs(curves, episodes)]
    ledger = _ledger(directory, notes)
    statuses: dict[tuple[object, ...], Counter[str]] = defaultdict(Counter)
    for row in ledger:
        statuses[tuple(row[name] for name in CELL)][row["status"]] += 1
    return {
        "title": directory.path.resolve().name,
        "metrics": sorted(metrics["metric"].unique()),
        "measures": [[name, MEASURES[name]] for name in measures],
        "environments": [
            {
                "env": env,
                "disturbance": disturbance,
                "references": _references(episodes, env, disturbance, measures),
                "ceiling": None,
            }
            for env, disturbance in environments
        ],
        "agents": [
            {
                "name": name,
                "colour": colour_of(name),
                "dark": colour_of(name, on_dark=True),
            }
            for name in algorithms
        ],
        "cells": [
            {
                "environment": environments.index((cell.env, cell.disturbance)),
                "agent": algorithms.index(cell.config.algorithm),
                "length": cell.config.history_length,
                "seeds": len(directory.seeds),
                "statuses": dict(statuses[tuple(cell.key.values())]),
                "curves": {m: curve_data(rows_of(curves, cell), m, "step") for m in measures},
                "learning": _learning(rows_of(metrics, cell)),
                "final": {m: _final(rows_of(lanes, cell), m) for m in measures},
            }
            for cell in directory.cells
        ],
        "study": _study(directory.cells, directory.seeds, directory.episodes),
        "status": dict(Counter(row["status"] for row in ledger)),
        "troubles": [row for row in ledger if row["status"] not in ("done", "planned")],
        "timing": _timing(log, directory),
        "made_with": _made_with(directory),
    }


def _with_log(
    curves: pd.DataFrame, log: list[dict[str, Any]], directory: RunDirectory
) -> pd.DataFrame:
    """The curves of ended lanes, and those of other lanes, which are only in the log."""
    key = [*CELL, "seed"]
    kept = set(curves[key].itertuples(index=False, name=None))
    study = {
        (*cell.key.values(), seed): cell for cell in directory.cells for seed in directory.seeds
    }
    rows: dict[tuple, dict[int, dict[str, Any]]] = defaultdict(dict)
    for row in log:
        lane = lane_of(row)
        value = row.get("return")
        if lane in study and lane not in kept and isinstance(value, float | int):
            # A lane that is trained again is logged again: its later rows are of no use then.
            for step in [step for step in rows[lane] if step > row["step"]]:
                del rows[lane][step]
            point = {name: row[name] for name in (*key, "step")}
            rows[lane][row["step"]] = {**point, "return": value, "true_return": math.nan}
    points = [
        point
        for lane, own in rows.items()
        if not _was_removed(directory, study[lane], lane[-1], max(own))
        for point in own.values()
    ]
    return pd.concat([curves, pd.DataFrame(points)[curves.columns]]) if points else curves


def _was_removed(directory: RunDirectory, cell: Cell, seed: int, step: int) -> bool:
    """Whether the file of a lane, whose log reaches ``step``, was removed to train it again."""
    place = directory.lanes.checkpoint_directory(cell, seed)
    return step >= cell.config.total_steps and not checkpoint_steps(place)


def _differs(curves: pd.DataFrame, episodes: pd.DataFrame) -> bool:
    """Whether any return differs from the return of the true state."""
    pairs = [table[["return", "true_return"]].dropna() for table in (curves, episodes)]
    return any(not np.allclose(pair["return"], pair["true_return"]) for pair in pairs)


def rows_of(table: pd.DataFrame, cell: Cell) -> pd.DataFrame:
    """The rows of a cell."""
    keep = np.ones(len(table), bool)
    for name, value in cell.key.items():
        keep &= (table[name] == value).to_numpy()
    return table[keep]


def _references(
    episodes: pd.DataFrame, env: str, disturbance: str, measures: list[str]
) -> list[dict[str, Any]]:
    """Mean return of each reference policy."""
    here = episodes[(episodes["env"] == env) & (episodes["disturbance"] == disturbance)]
    here = here[~is_trained(here)]
    found = []
    for name in reference_names(here):
        of_policy = here[here["algorithm"] == name]
        means = {m: rounded_number(reference_mean(of_policy[m])) for m in measures}
        found.append({"name": name, **means})
    return found


def curve_data(rows: pd.DataFrame, measure: str, along: str) -> dict[str, Any] | None:
    """IQM over the seeds with the bounds of its interval, at each value of the column ``along``.

    The page calls these values "steps". Of more than `rtd3jax.study.statistics.MOST_POINTS` values,
    this number is kept, evenly spaced. The result is None without a finite value.
    """
    rows = rows[np.isfinite(rows[measure].astype(np.float64))]
    if rows.empty:
        return None
    table = thinned(rows.pivot(index="seed", columns=along, values=measure))
    count, iqm, low, high = iqm_bands(table.to_numpy(np.float64))
    number = int if table.columns.dtype.kind in "iu" else rounded_number  # steps keep all digits
    return {
        "steps": [number(value) for value in table.columns],
        "seeds": [int(seeds) for seeds in count],
        "iqm": [rounded_number(value) for value in iqm],
        "low": [rounded_number(value) for value in low],
        "high": [rounded_number(value) for value in high],
    }


def _learning(rows: pd.DataFrame) -> dict[str, Any]:
    """Mean of each metric over the seeds, at each evaluation with a measurement."""
    found = {}
    for metric, here in rows.dropna(subset="value").groupby("metric"):
        table = here.pivot(index="seed", columns="step", values="value")
        nothing = [None] * table.shape[1]
        found[metric] = {
            "steps": [int(step) for step in table.columns],
            "seeds": [int(seeds) for seeds in table.count()],
            "iqm": [rounded_number(value) for value in table.mean()],
            "low": nothing,
            "high": nothing,
        }
    return found


def _final(lanes: pd.DataFrame, measure: str) -> dict[str, Any] | None:
    """The final evaluation: the mean of each seed, and the summary of the means."""
    if lanes.empty:
        return None
    values = lanes[measure].to_numpy(np.float64)
    return {
        **summary_data(summarise(values)),
        "values": [rounded_number(value) for value in values if math.isfinite(value)],
    }


def summary_data(summary: Summary) -> dict[str, Any]:
    """The aggregates of a cell."""
    return {
        "n": summary.n,
        "lost": summary.failed,
        "mean": rounded_number(summary.mean),
        "std": rounded_number(summary.std),
        "iqm": rounded_number(summary.iqm),
        "low": rounded_number(summary.iqm_low),
        "high": rounded_number(summary.iqm_high),
    }


def _study(cells: list[Cell], seeds: list[int], episodes: int) -> dict[str, Any]:
    """Common settings of all cells, and the values of settings that differ."""
    about = {field.name: field.metadata["help"] for field in dataclasses.fields(Config)}
    dicts = [cell.to_dict() for cell in cells]
    rows = []
    for name in dicts[0]:
        values = list(dict.fromkeys(fields[name] for fields in dicts))
        rows.append({"name": name, "values": values, "about": about.get(name, "")})
    return {"cells": len(cells), "seeds": list(seeds), "episodes": episodes, "settings": rows}


def _ledger(directory: RunDirectory, notes: list[str]) -> list[dict[str, Any]]:
    try:
        return ledger(directory)
    except UserError as error:
        notes.append(f"the state of the lanes is not known: {error}")
        return []


_SWAPPED = 0.1
"""Seconds by which rows of processes that write at the same time may be out of order."""


def _timing(rows: list[dict[str, Any]], directory: RunDirectory) -> dict[str, Any] | None:
    """Times from the log; the clock starts at zero in each session.

    If several shards or tasks of a cluster write the log at the same time, each with its own clock,
    the sum of their times has no meaning and is left out. The number of shards is 0 for a cluster.
    """
    stamps = [row.get("seconds") for row in rows]
    if not rows or not all(isinstance(stamp, int | float) for stamp in stamps):
        return None
    steps = sum(steps_reached(rows).values())
    shards = [
        entry for entry in directory.path.iterdir() if re.match(r"\.lock-\d+-of-", entry.name)
    ]
    if shards:
        return {"steps": steps, "shards": len(shards)}
    if (directory.path / TASKS).exists():  # each task of a cluster has its own clock, too
        return {"steps": steps, "shards": 0}
    following = [*stamps[1:], -1.0]
    ends = [a for a, b in zip(stamps, following, strict=True) if a is not None and b < a - _SWAPPED]
    seconds = sum(ends)
    return {
        "steps": steps,
        "sessions": len(ends),
        "seconds": rounded_number(seconds),
        "steps_per_second": rounded_number(steps / seconds) if seconds else None,
    }


def _made_with(directory: RunDirectory) -> dict[str, Any]:
    try:
        found = json.loads((directory.path / "config.json").read_text("utf-8"))["made_with"]
        return found if isinstance(found, dict) else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}
