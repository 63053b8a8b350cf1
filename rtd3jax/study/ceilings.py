"""Ceilings of a study's environments, which the run directory stores."""

import contextlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtd3jax.envs.disturbed import with_true_reward
from rtd3jax.errors import UserError, short_reason
from rtd3jax.evaluation.ceiling import ceiling
from rtd3jax.study.cells import Cell
from rtd3jax.study.results import rounded_number
from rtd3jax.system.files import write_bytes_atomically
from rtd3jax.system.versions import versions_of

FILE = "ceilings.json"


def ceilings_of(
    directory: Path, cells: Sequence[Cell], *, compute: bool
) -> dict[tuple[str, str], dict[str, Any]]:
    """The ceilings of the environments of ``cells``, by (env, disturbance).

    An entry has ``mean``, ``error`` (the standard error), ``kind``, and ``measure``: ``return``, or
    ``true_return`` if only the ceiling of the return of the true state is known. With ``compute``,
    missing ceilings are computed and stored; if a ceiling is not known, the only item of the entry
    is ``missing``, the reason. Without ``compute``, only stored ceilings of this version of the
    package are returned.
    """
    path = directory / FILE
    version = versions_of(["rtd3jax"])["rtd3jax"]
    kept = _read(path, version)
    found, before = {}, len(kept)
    for environment, cell in {(cell.env, cell.disturbance): cell for cell in cells}.items():
        name = " | ".join(environment)
        if name not in kept and compute:
            try:
                kept[name] = _ceiling(cell)
            except UserError as error:
                found[environment] = {"missing": str(error)}
        if name in kept:
            found[environment] = kept[name]
    if len(kept) > before:
        text = json.dumps({"rtd3jax": version, "ceilings": kept}, indent=1)
        with contextlib.suppress(OSError):  # a directory may be read-only: they are computed again
            write_bytes_atomically(path, text.encode())
    return found


def compute_ceilings(directory: Path, cells: Sequence[Cell]) -> None:
    """Compute and store the missing ceilings; an error is printed, and the sweep continues."""
    try:
        ceilings_of(directory, cells, compute=True)
    except Exception as error:
        reason = short_reason(error)
        print(f"no ceilings: {reason}", file=sys.stderr)


def _ceiling(cell: Cell) -> dict[str, Any]:
    env, measure = cell.make_env(), "return"
    try:
        best = ceiling(env, env_id=cell.env)
    except UserError:
        truth, measure = with_true_reward(env), "true_return"
        if truth is env:
            raise
        best = ceiling(truth, env_id=cell.env)
    mean, error = rounded_number(best.mean), rounded_number(best.standard_error)
    return {"mean": mean, "error": error, "kind": best.kind, "measure": measure}


def _read(path: Path, version: str) -> dict[str, dict[str, Any]]:
    try:
        content = json.loads(path.read_text("utf-8"))
        if content["rtd3jax"] == version:
            return {
                name: entry
                for name, entry in content["ceilings"].items()
                if {"mean", "error", "kind", "measure"} <= set(entry)
            }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass  # there is no file, or another version wrote it
    return {}
