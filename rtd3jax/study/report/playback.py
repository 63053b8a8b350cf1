"""Records episodes of trained policies, step by step and compactly, for the page.

Frame t is the result of action t: the next observation of the agent, the undisturbed observation,
the action, the reward, and the hidden variable, if the environment provides it.
"""

import base64
import contextlib
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rtd3jax.envs.description import Drawing
from rtd3jax.envs.disturbed import Disturbed, seen_elements
from rtd3jax.envs.entry import step_limit
from rtd3jax.envs.registry import description_of
from rtd3jax.errors import UserError, short_reason
from rtd3jax.evaluation.rollout import element_names, play_episodes
from rtd3jax.protocols import EnvironmentLike, PolicyLike
from rtd3jax.study.cells import Cell
from rtd3jax.study.lane_files import cell_name
from rtd3jax.study.report.data import rows_of
from rtd3jax.study.results import rounded_number
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import write_bytes_atomically

FORMAT = 2
EPISODES = 2
SEED = 0
"""Seed of the episodes for all agents, so that they meet the same disturbances."""
MOST_STEPS = 500
"""Maximum number of recorded steps of an episode."""
MOST_CELLS = 60
"""Up to this number of cells, each has two episodes; in a larger study, each has one."""


def recordings(
    directory: RunDirectory, lanes: pd.DataFrame, *, record: bool, notes: list[str]
) -> list[dict[str, Any]]:
    """A recording for each cell with a trained policy, in the order of the cells.

    ``lanes`` are the `seed_means` of the final evaluation, which determine the policy's seed.
    The recordings are stored in ``playback/``, and made again when the lane's file changes. Without
    ``record``, only stored recordings are returned.
    """
    count = EPISODES if len(directory.cells) <= MOST_CELLS else 1
    longest = max(cell.config.window_tokens for cell in directory.cells)
    found: list[dict[str, Any]] = []
    problems: dict[str, list[str]] = {}
    for index, cell in enumerate(directory.cells):
        seed = _middle_seed(directory, cell, lanes)
        if seed is None:
            continue
        lane = directory.lanes.digest(cell, seed)
        stamp = {"format": FORMAT, "lane": lane, "episodes": count}
        path = directory.lanes.playback_path(cell, seed)
        kept = _read(path, stamp)
        if kept is None and record:
            try:
                kept = {**stamp, **_recorded(directory, cell, seed, longest, count)}
            except UserError as error:
                problems.setdefault(str(error), []).append(f"{cell_name(cell)} {path.stem}")
                continue
            with contextlib.suppress(OSError):  # the run may be read-only: recorded again next time
                write_bytes_atomically(path, json.dumps(kept).encode())
        if kept is not None:
            shown = {name: value for name, value in kept.items() if name not in stamp}
            found.append({"cell": index, "seed": seed, **shown})
    notes += [f"no playback of {', '.join(names)}: {why}" for why, names in problems.items()]
    return found


def record_episodes(
    policy: PolicyLike,
    env: EnvironmentLike,
    episodes: int,
    seed: int,
    steps: int,
    hidden: Callable[[Any], Any] | None = None,
) -> dict[str, np.ndarray]:
    """Play ``episodes`` of at most ``steps`` steps: arrays [episodes, steps, ...] by name.

    ``hidden`` is the function in the environment's `rtd3jax.envs.description.Drawing`.

    The episodes are those of ``evaluate(policy, env, episodes, seed)``. ``done`` marks the frame in
    which an episode ended; later frames have no meaning.
    """
    played = play_episodes(policy, env, episodes, seed, steps, hidden)
    frames = {
        "seen": played["seen"][:, 1:],
        "true": played["true"][:, 1:],
        "action": played["action"],
        "reward": played["reward"][..., None],
        "done": played["terminated"] | played["truncated"],
    }
    return {**frames, "hidden": played["hidden"]} if "hidden" in played else frames


def _recorded(
    directory: RunDirectory, cell: Cell, seed: int, longest: int, count: int
) -> dict[str, Any]:
    env, policy = cell.make_env(), directory.lanes.policy(cell, seed)
    if policy.window_tokens:
        # The same window for all lengths, so that they share a program; a policy keeps its length.
        policy = dataclasses.replace(policy, window_tokens=longest)
    limit = int(step_limit(env.default_params))
    drawing = description_of(env, cell.env).drawing or Drawing()
    steps = min(limit, MOST_STEPS)
    try:
        frames = record_episodes(policy, env, count, SEED, steps, drawing.hidden)
    except UserError:
        raise
    except Exception as error:  # a user's environment may raise any error
        raise UserError(short_reason(error)) from error
    cut = limit > MOST_STEPS and not frames["done"].any(axis=1).all()
    return {
        **_scene(env, drawing, {name: value.shape[-1] for name, value in frames.items()}),
        "cut": MOST_STEPS if cut else None,
        "runs": [_packed({n: value[k] for n, value in frames.items()}) for k in range(count)],
    }


def _scene(env: EnvironmentLike, drawing: Drawing, sizes: dict[str, int]) -> dict[str, Any]:
    """Data of the page for drawing: the scene, the names of elements, and constants.

    Args:
        env: the environment with its disturbances.
        drawing: the environment's drawing; elements without a name are numbered.
        sizes: number of elements of each array of a frame.
    """
    params = env.default_params
    elements = seen_elements(env, params, sizes["true"])
    if isinstance(env, Disturbed):
        params = params.env
    seconds = drawing.step_seconds
    met = None
    if "hidden" in sizes:
        names = element_names(drawing.hidden_elements, "h", sizes["hidden"])
        met = {"name": drawing.hidden_name, "elements": names}
    return {
        "kind": drawing.kind,
        "names": element_names(drawing.observation, "o", sizes["true"]),
        # For each observed element, the index of the true element; None if it is not known.
        "elements": elements if len(elements) == sizes["seen"] else None,
        "actions": element_names(drawing.action, "a", sizes["action"]),
        "seconds": None if seconds is None else rounded_number(getattr(params, seconds)),
        "constants": {name: rounded_number(getattr(params, name)) for name in drawing.constants},
        "hidden": met,
    }


def _packed(frames: dict[str, np.ndarray]) -> dict[str, Any]:
    """The frames of an episode up to its end, with 16 bits per number and a scale per element."""
    done = np.flatnonzero(frames.pop("done"))
    length = int(done[0]) + 1 if done.size else len(frames["reward"])
    packed: dict[str, Any] = {"steps": length}
    if np.array_equal(frames["seen"], frames["true"]):
        frames.pop("seen")  # equal to the true observation
    for name, values in frames.items():
        values = values[:length].astype(np.float64)
        if not np.all(np.isfinite(values)):
            raise UserError(f"the {name} of an episode is not finite")
        scale = np.maximum(np.abs(values).max(axis=0), 1e-9) / 32_767
        data = np.round(values / scale).astype("<i2")
        packed[name] = {
            "scale": [float(f"{s:.6g}") for s in scale],
            "data": base64.b64encode(data.tobytes()).decode(),
        }
    return packed


def _middle_seed(directory: RunDirectory, cell: Cell, lanes: pd.DataFrame) -> int | None:
    """A typical seed: its final return is the cell's median (the lower of two medians)."""
    rows = rows_of(lanes, cell)
    rows = rows[np.isfinite(rows["return"])].sort_values(["return", "seed"])
    seeds = [int(seed) for seed in rows["seed"] if directory.lanes.is_done(cell, int(seed))]
    return seeds[(len(seeds) - 1) // 2] if seeds else None


def _read(path: Path, stamp: dict[str, Any]) -> dict[str, Any] | None:
    try:
        content = json.loads(path.read_text("utf-8"))
        if all(content[name] == value for name, value in stamp.items()) and content["runs"]:
            return content
    except (OSError, ValueError, KeyError, TypeError):
        pass  # no recording, or an old one
    return None
