"""Episodes of trained policies, step by step, small enough to travel inside the page.

Frame t is what followed from the t-th action: the observation that the agent saw next, the true one
behind it, the action, its reward, and where the environment tells it what the action met unseen.
"""

import base64
import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from rtd3jax.envs.about import Drawing
from rtd3jax.envs.disturbed import Disturbed
from rtd3jax.envs.entry import parameters_of
from rtd3jax.envs.interface import DEFAULT_STEP_LIMIT, describe, foreign_code
from rtd3jax.envs.processes.disturbances import Hidden
from rtd3jax.envs.processes.process import Chain
from rtd3jax.envs.registry import about_of
from rtd3jax.errors import UserError, first_line
from rtd3jax.policies.fit import check_fit
from rtd3jax.protocols import EnvironmentLike, PolicyLike
from rtd3jax.study.plan import Cell
from rtd3jax.study.report.data import rows_of
from rtd3jax.study.results import rounded_number
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import write_bytes_atomically
from rtd3jax.system.program_cache import make_room

FORMAT = 2
EPISODES = 2
SEED = 0
"""Of the episodes, the same for all agents: in one world they meet the same disturbance."""
MOST_STEPS = 500
"""Steps of an episode that are kept."""
MOST_CELLS = 60
"""Cells with two episodes each; in a larger study each has one, so that the page stays small."""


def recordings(
    directory: RunDirectory, lanes: pd.DataFrame, *, record: bool, notes: list[str]
) -> list[dict[str, Any]]:
    """A recording of every cell that has a trained policy, in the order of cells.

    ``lanes`` are the `seed_means` of the final evaluation, by which the seed is chosen.
    Kept in ``playback/`` beside the lanes, and made anew when the lane's file is another. Without
    ``record``, only those that are kept.
    """
    count = EPISODES if len(directory.cells) <= MOST_CELLS else 1
    longest = max(cell.config.tokens for cell in directory.cells)
    found: list[dict[str, Any]] = []
    problems: dict[str, list[str]] = {}
    for index, cell in enumerate(directory.cells):
        seed = _middle_seed(directory, cell, lanes)
        if seed is None:
            continue
        digest = hashlib.sha256(directory.lane_path(cell, seed).read_bytes()).hexdigest()
        stamp = {"format": FORMAT, "lane": digest, "episodes": count}
        path = directory.playback_path(cell, seed)
        kept = _read(path, stamp)
        if kept is None and record:
            try:
                kept = {**stamp, **_recorded(directory, cell, seed, longest, count)}
            except UserError as error:
                problems.setdefault(str(error), []).append(path.stem)
                continue
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
    """Play ``episodes`` of ``steps`` at most: arrays [episodes, steps, ...] by name.

    ``hidden`` is that of the environment's `rtd3jax.envs.about.Drawing`.

    Episodes are those of ``evaluate(policy, env, episodes, seed)``. ``done`` says in which frame an
    episode ended; later frames mean nothing.
    """
    params = parameters_of(env)
    own = describe(env, params)
    check_fit(policy, own.observation_size, own.action_shape, own.action_low, own.action_high)
    make_room()
    frames = _play(policy, env, params, jax.random.key(seed), episodes, steps, hidden)
    return {name: np.asarray(value) for name, value in frames.items()}


@functools.partial(jax.jit, static_argnames=("env", "episodes", "steps", "hidden"))
def _play(policy, env, params, key, episodes, steps, hidden):
    policy_key, reset_key, step_key = jax.random.split(key, 3)
    with foreign_code():
        observation, state = jax.vmap(env.reset, in_axes=(0, None))(
            jax.random.split(reset_key, episodes), params
        )
    memory = jax.vmap(policy.init)(jax.random.split(policy_key, episodes))

    def step(loop, time):
        memory, state, observation = loop
        action, memory = jax.vmap(policy.step)(memory, observation)
        met = None
        if hidden is not None:
            met = hidden(state.env if isinstance(env, Disturbed) else state)
        keys = jax.random.split(jax.random.fold_in(step_key, time), episodes)
        with foreign_code():
            observation, state, reward, terminated, truncated, info = jax.vmap(
                env.step, in_axes=(0, 0, 0, None)
            )(keys, state, action, params)
        seen = info["final_observation"].astype(jnp.float32)
        frame = {
            "seen": seen,
            "true": jnp.asarray(info.get("true_observation", seen), jnp.float32),
            "action": action.reshape(episodes, -1).astype(jnp.float32),
            "reward": reward.astype(jnp.float32)[:, None],
            "done": terminated.astype(bool) | truncated.astype(bool),
        }
        if met is not None:
            frame["hidden"] = jnp.asarray(met, jnp.float32).reshape(episodes, -1)
        return (memory, state, observation.astype(jnp.float32)), frame

    start = (memory, state, observation.astype(jnp.float32))
    _, frames = jax.lax.scan(step, start, jnp.arange(steps, dtype=jnp.int32))
    return {name: jnp.swapaxes(value, 0, 1) for name, value in frames.items()}


def _recorded(
    directory: RunDirectory, cell: Cell, seed: int, longest: int, count: int
) -> dict[str, Any]:
    env, policy = cell.make_env(), directory.policy(cell, seed)
    if policy.tokens:
        # One window for all lengths, so that they share a program; a policy minds its own length.
        policy = dataclasses.replace(policy, tokens=longest)
    limit = int(getattr(env.default_params, "max_steps_in_episode", DEFAULT_STEP_LIMIT))
    drawing = about_of(env, cell.env).drawing or Drawing()
    steps = min(limit, MOST_STEPS)
    try:
        frames = record_episodes(policy, env, count, SEED, steps, drawing.hidden)
    except UserError:
        raise
    except Exception as error:  # a user's environment may do anything
        raise UserError(first_line(error)) from error
    cut = limit > MOST_STEPS and not frames["done"].any(axis=1).all()
    return {
        **_scene(env, drawing, {name: value.shape[-1] for name, value in frames.items()}),
        "cut": MOST_STEPS if cut else None,
        "runs": [_packed({n: value[k] for n, value in frames.items()}) for k in range(count)],
    }


def _scene(env: EnvironmentLike, drawing: Drawing, sizes: dict[str, int]) -> dict[str, Any]:
    """What the page has to know: kind of scene, names of elements, and constants.

    Args:
        env: the environment as it was made.
        drawing: how it is drawn; what it does not name is numbered.
        sizes: elements of each frame's arrays.
    """
    params, elements = env.default_params, list(range(sizes["true"]))
    if isinstance(env, Disturbed):
        process, params = params.observation, params.env
        processes = process.processes if isinstance(process, Chain) else (process,)
        for part in processes:
            if isinstance(part, Hidden):
                del elements[part.element]
    seconds = drawing.step_seconds
    met = None
    if "hidden" in sizes:
        names = _names(drawing.hidden_elements, "h", sizes["hidden"])
        met = {"name": drawing.hidden_name, "elements": names}
    return {
        "kind": drawing.kind,
        "names": _names(drawing.observation, "o", sizes["true"]),
        # Which true element each seen one shows; None where that is not known.
        "elements": elements if len(elements) == sizes["seen"] else None,
        "actions": _names(drawing.action, "a", sizes["action"]),
        "seconds": None if seconds is None else rounded_number(getattr(params, seconds)),
        "constants": {name: rounded_number(getattr(params, name)) for name in drawing.constants},
        "hidden": met,
    }


def _names(given: tuple[str, ...], letter: str, size: int) -> list[str]:
    """The names given, if there are as many as elements; else numbered ones."""
    if len(given) == size:
        return list(given)
    return [f"{letter}[{k}]" for k in range(size)]


def _packed(frames: dict[str, np.ndarray]) -> dict[str, Any]:
    """One episode's frames up to its end: 16 bits a number, a scale for each element."""
    done = np.flatnonzero(frames.pop("done"))
    length = int(done[0]) + 1 if done.size else len(frames["reward"])
    packed: dict[str, Any] = {"steps": length}
    if np.array_equal(frames["seen"], frames["true"]):
        frames.pop("seen")  # the agent sees the truth
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
    """The seed whose final return is the cell's median (the lower one of two): a typical agent."""
    rows = rows_of(lanes, cell)
    rows = rows[np.isfinite(rows["return"])].sort_values(["return", "seed"])
    seeds = [int(seed) for seed in rows["seed"] if directory.is_done(cell, int(seed))]
    return seeds[(len(seeds) - 1) // 2] if seeds else None


def _read(path: Path, stamp: dict[str, Any]) -> dict[str, Any] | None:
    try:
        content = json.loads(path.read_text("utf-8"))
        if all(content[name] == value for name, value in stamp.items()) and content["runs"]:
            return content
    except (OSError, ValueError, KeyError, TypeError):
        pass  # none, or another's
    return None
