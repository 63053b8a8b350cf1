"""Writes tables, figures and the summary of a study, only from the files of its lanes.

So the result does not depend on the order in which lanes ended, and can be repeated at any time.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rtd3jax.errors import UserError
from rtd3jax.study.ceilings import ceilings_of
from rtd3jax.study.figures import final_returns, learning_curves
from rtd3jax.study.lane_files import LaneFiles
from rtd3jax.study.lock import deriver
from rtd3jax.study.plan import Cell
from rtd3jax.study.results import (
    CURVES,
    EPISODES,
    METRICS,
    REFERENCE_SEED,
    read_table,
    write_table,
)
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.summary import summary_markdown
from rtd3jax.system.files import read_arrays, write_bytes_atomically

_CURVE_ARRAYS = ("steps", "returns", "true_returns")
_FINAL_ARRAYS = ("final_returns", "final_true_returns")


@dataclasses.dataclass(frozen=True)
class Reference:
    """Returns of a policy that needs no training, [episodes] for each measure."""

    env: str
    disturbance: str
    name: str
    returns: np.ndarray
    true_returns: np.ndarray


def derive(
    directory: RunDirectory, references: Iterable[Reference], *, pictures: bool = True
) -> None:
    """Write tables, figures and the summary of the lanes that have ended."""
    # If shards end together, the last one that holds the lock reads the lanes of all.
    with deriver(directory.path):
        _derive(directory, references, pictures)


def _derive(directory: RunDirectory, references: Iterable[Reference], pictures: bool) -> None:
    curves: list[dict[str, Any]] = []
    episodes: list[dict[str, Any]] = []
    failures: list[dict[str, Any]] = []
    metrics: list[dict[str, Any]] = []
    for cell in directory.cells:
        for seed in directory.seeds:
            if directory.lanes.is_done(cell, seed):
                _read_lane(directory.lanes, cell, seed, curves, episodes, metrics, failures)
            elif (reason := directory.lanes.error(cell, seed)) is not None:
                failures.append(
                    {**cell.key, "seed": seed, "step": "?", "reason": f"failed: {reason}"}
                )
    for reference in references:
        episodes += _reference_rows(reference)
    write_table(directory.path / "curves.parquet", curves, CURVES)
    write_table(directory.path / "episodes.parquet", episodes, EPISODES)
    write_table(directory.path / "metrics.parquet", metrics, METRICS)
    curve_table = read_table(directory.path / "curves.parquet", CURVES)
    episode_table = read_table(directory.path / "episodes.parquet", EPISODES)
    best = ceilings_of(directory.path, directory.cells, compute=False)
    text = summary_markdown(_excerpt(directory), curve_table, episode_table, failures, best)
    write_bytes_atomically(directory.path / "summary.md", text.encode())
    if pictures:
        learning_curves(curve_table, episode_table, directory.path, best)
        final_returns(episode_table, directory.path, best)


def _read_lane(
    lanes: LaneFiles,
    cell: Cell,
    seed: int,
    curves: list[dict[str, Any]],
    episodes: list[dict[str, Any]],
    metrics: list[dict[str, Any]],
    failures: list[dict[str, Any]],
) -> None:
    path = lanes.lane_path(cell, seed)
    row = {**cell.key, "seed": seed}
    try:
        arrays, metadata = read_arrays(path)
        failure = metadata["failure"]
        points = zip(*(arrays[f"results.{n}"] for n in _CURVE_ARRAYS), strict=True)
        finals = zip(*(arrays[f"results.{n}"] for n in _FINAL_ARRAYS), strict=True)
        curves += [
            {**row, "step": int(step), "return": value, "true_return": true}
            for step, value, true in points
        ]
        episodes += [
            {**row, "episode": episode, "return": value, "true_return": true}
            for episode, (value, true) in enumerate(finals)
        ]
        metrics += [
            {**row, "step": int(step), "metric": name.removeprefix("metrics."), "value": value}
            for name in sorted(arrays)
            if name.startswith("metrics.")
            for step, value in zip(arrays["results.steps"], arrays[name], strict=True)
        ]
    except (UserError, KeyError, ValueError, TypeError) as error:
        raise UserError(
            f"{error}: remove {path} and repeat the command to train this lane again"
        ) from error
    if failure is not None:
        failures.append({**row, **failure})


def _excerpt(directory: RunDirectory) -> dict[str, object]:
    """Common settings of the cells, and the fields that differ, for the summary."""
    dicts = [cell.to_dict() for cell in directory.cells]
    fields = {}
    for name in dicts[0]:
        if len({cell[name] for cell in dicts}) == 1:
            fields[name] = dicts[0][name]
        elif name not in directory.cells[0].key:  # fields of the key are in the summary's tables
            fields[name] = _values_and_owners(name, dicts)
    return {
        "cells": len(directory.cells),
        "seeds": len(directory.seeds),
        "final episodes per seed": directory.episodes,
        **_began_from(directory),
        **fields,
    }


def _began_from(directory: RunDirectory) -> dict[str, object]:
    """The networks from which lanes started, if any did."""
    paths = (
        directory.lanes.start_path(c, seed) for c in directory.cells for seed in directory.seeds
    )
    found = dict.fromkeys(path.read_text("utf-8").strip() for path in paths if path.exists())
    return {"began from": "; ".join(found)} if found else {}


def _values_and_owners(name: str, cells: Sequence[Mapping[str, Any]]) -> str:
    """Each value of a field, followed by the environments or agents that have this value."""
    within: dict[str, set[Any]] = {}
    for cell in cells:
        within.setdefault(cell["env"], set()).add(cell[name])
    owners: dict[Any, dict[str, None]] = {}
    for cell in cells:
        env, algorithm = cell["env"], cell["algorithm"]
        one = f"{env}: {algorithm}" if len(within) > 1 else algorithm
        owners.setdefault(cell[name], {})[env if len(within[env]) == 1 else one] = None
    return "; ".join(f"{value} ({', '.join(own)})" for value, own in owners.items())


def _reference_rows(reference: Reference) -> list[dict[str, Any]]:
    key = {
        "env": reference.env,
        "disturbance": reference.disturbance,
        "algorithm": reference.name,
        "history_length": 0,
        "seed": REFERENCE_SEED,
    }
    pairs = zip(reference.returns, reference.true_returns, strict=True)
    return [
        {**key, "episode": episode, "return": value, "true_return": true}
        for episode, (value, true) in enumerate(pairs)
    ]
