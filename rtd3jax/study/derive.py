"""Writes tables, figures and the summary of a study, only from the files of its lanes.

So the result does not depend on the order in which lanes ended, and can be repeated at any time.
"""

import contextlib
import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rtd3jax.study.ceilings import ceilings_of
from rtd3jax.study.figures import final_returns, learning_curves
from rtd3jax.study.lock import deriver
from rtd3jax.study.results import REFERENCE_SEED, read_table, write_table
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.summary import summary_markdown
from rtd3jax.study.tables import SCHEMAS, rows_of_lanes
from rtd3jax.system.files import write_text_atomically


@dataclasses.dataclass(frozen=True)
class Reference:
    """Returns of a policy that needs no training, [episodes] for each measure."""

    env: str
    disturbance: str
    name: str
    returns: np.ndarray
    true_returns: np.ndarray


def derive(
    directory: RunDirectory,
    references: Iterable[Reference],
    *,
    wait: bool = True,
    pictures: bool = True,
    locked: bool = False,
) -> None:
    """Write tables, figures and the summary of the lanes that have ended.

    Args:
        directory: the run directory.
        references: policies that need no training.
        wait: whether to wait while another process writes them.
        pictures: whether to draw the figures.
        locked: whether the caller holds the lock `deriver` already.

    Raises:
        UserError: when the file of a lane is damaged.
        BlockingIOError: when another process writes them now, and ``wait`` is false.
    """
    # If shards end together, the last one that holds the lock reads the lanes of all.
    with contextlib.nullcontext() if locked else deriver(directory.path, wait):
        _derive(directory, references, pictures)


def _derive(directory: RunDirectory, references: Iterable[Reference], pictures: bool) -> None:
    rows = rows_of_lanes(directory)
    for reference in references:
        rows.episodes.extend(_reference_rows(reference))
    tables = {}
    for name, schema in SCHEMAS.items():
        path = directory.path / f"{name}.parquet"
        write_table(path, vars(rows)[name], schema)
        tables[name] = read_table(path, schema)
    best = ceilings_of(directory.path, directory.cells, compute=False)
    curves, episodes = tables["curves"], tables["episodes"]
    planned = {tuple(cell.key.values()): directory.seeds for cell in directory.cells}
    text = summary_markdown(_excerpt(directory), planned, episodes, rows.failures, best)
    write_text_atomically(directory.path / "summary.md", text)
    if pictures:
        learning_curves(curves, episodes, directory.path, best)
        final_returns(episodes, directory.path, best)


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
