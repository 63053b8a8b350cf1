"""Plays episodes of a policy and keeps every step, for plots and tables."""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.envs.compat.simulated import release
from rtd3jax.envs.description import Drawing
from rtd3jax.envs.disturbed import Disturbed, seen_elements
from rtd3jax.envs.entry import parameters_of, step_limit
from rtd3jax.envs.interface import (
    Interface,
    describe,
    environment_name,
    foreign_code,
)
from rtd3jax.envs.registry import description_of
from rtd3jax.evaluation.play import begin_episodes, checked, parts_of, take_step
from rtd3jax.protocols import EnvironmentLike, PolicyLike
from rtd3jax.system.jax_settings import random_key
from rtd3jax.system.numbers import check_counts
from rtd3jax.system.program_cache import make_room
from rtd3jax.system.pytrees import node_types

if TYPE_CHECKING:  # importing pandas takes a second
    import pandas as pd


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectory:
    """Episodes as arrays: E episodes; the longest has T steps.

    Entries after the end of an episode are NaN or False. Row t of the observations is the
    observation for which action t was chosen; row ``lengths`` is the final observation.

    Attributes:
        seen: float32 [E, T + 1, O], the observations of the policy.
        true: float32 [E, T + 1, S], the undisturbed observations; NaN in row 0 if the environment
            has them in ``info`` but no method ``true_observation``.
        actions: float32 [E, T, A], flat, in the environment's units.
        rewards: float32 [E, T], the rewards of the environment.
        true_rewards: float32 [E, T], rewards of the undisturbed state, if the environment provides
            them; else the rewards.
        terminated: bool [E, T], whether the episode terminated after this step.
        truncated: bool [E, T], whether the time limit was reached after this step.
        hidden: float32 [E, T, K], the hidden variable during step t; None if the environment's
            `Drawing` has no hidden variable.
        lengths: int64 [E], number of steps of each episode.
        action_low: float32 [A], the lowest action.
        action_high: float32 [A], the highest action.
        observation_names: S names of the undisturbed observation's elements.
        seen_names: O names of the observed elements; ``s[0]``, ``s[1]``, ... if it is not known
            which elements of the undisturbed observation they are.
        action_names: A names.
        hidden_names: K names.
        environment: the name of the environment.
        seed: the seed of the episodes.
        step_seconds: length of a step in s; None if it is not known.
    """

    seen: np.ndarray
    true: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    true_rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    hidden: np.ndarray | None
    lengths: np.ndarray
    action_low: np.ndarray
    action_high: np.ndarray
    observation_names: tuple[str, ...]
    seen_names: tuple[str, ...]
    action_names: tuple[str, ...]
    hidden_names: tuple[str, ...]
    environment: str
    seed: int
    step_seconds: float | None

    @property
    def returns(self) -> np.ndarray:
        """The return of each episode: sums of ``rewards``, float32 [E]."""
        played = np.arange(self.rewards.shape[1])[None, :] < self.lengths[:, None]
        return np.sum(self.rewards, axis=1, where=played)

    def to_frame(self) -> "pd.DataFrame":
        """A row for each observation of each episode.

        Columns: ``episode``, ``step``, ``time`` (s, if the length of a step is known), ``seen X``
        and ``true X`` for each element of the observation, ``action X``, ``reward``, ``true
        reward``, ``terminated``, ``truncated``, and the names of the hidden variable, such as
        ``slip left``.

        The last row of an episode holds the final observation. No action follows it, so its action,
        rewards and hidden variable are NaN, and ``terminated`` and ``truncated`` are False.
        """
        import pandas as pd

        parts = []
        for episode, length in enumerate(self.lengths):
            step = np.arange(length + 1)
            columns: dict[str, Any] = {"episode": episode, "step": step}
            if self.step_seconds is not None:
                columns["time"] = step * self.step_seconds
            here = slice(0, length + 1)
            columns |= _named("seen", self.seen_names, self.seen[episode, here])
            columns |= _named("true", self.observation_names, self.true[episode, here])
            columns |= _named("action", self.action_names, _row_more(self.actions[episode], length))
            columns["reward"] = _row_more(self.rewards[episode], length)
            columns["true reward"] = _row_more(self.true_rewards[episode], length)
            for name in ("terminated", "truncated"):
                columns[name] = np.append(getattr(self, name)[episode, :length], False)
            if self.hidden is not None:
                columns |= _named("", self.hidden_names, _row_more(self.hidden[episode], length))
            parts.append(pd.DataFrame(columns))
        return pd.concat(parts, ignore_index=True)


def rollout(
    policy: PolicyLike,
    env: EnvironmentLike,
    seed: int = 0,
    episodes: int = 1,
    *,
    params: object = None,
    steps: int | None = None,
) -> Trajectory:
    """Play episodes of ``policy``, and keep every step.

    The episodes are those of ``rtd.evaluate(policy, env, episodes, seed)``: they have the same
    starts and the same disturbances.

    Args:
        policy: anything with ``init`` and ``step``; see `rtd3jax.policies`.
        env: a gymnax >= 1.0 environment. The `Drawing` of its registration defines the names of
            elements and the hidden variable.
        seed: seed of the environment's random streams.
        episodes: number of episodes, played together as by `rtd3jax.evaluate`.
        params: the environment's parameters; its default parameters by default.
        steps: number of steps after which episodes are cut; by default their time limit.

    Raises:
        UserError: for an unsuitable environment or impossible arguments.
    """
    params = parameters_of(env, params)
    limit = int(step_limit(params))
    steps = limit if steps is None else steps
    check_counts(episodes, seed)
    check_counts(steps, 0, "steps")
    drawing = description_of(env).drawing or Drawing()
    played = play_episodes(
        policy, env, int(episodes), int(seed), min(int(steps), limit), drawing.hidden, params=params
    )
    return _trajectory(played, env, params, drawing, int(seed))


def play_episodes(
    policy: PolicyLike,
    env: EnvironmentLike,
    episodes: int,
    seed: int,
    steps: int,
    hidden: Callable[[Any], Any] | None = None,
    *,
    params: object = None,
) -> dict[str, np.ndarray]:
    """Play ``steps`` steps of each episode, with ``hidden`` of a `Drawing`.

    Returns:
        Arrays by name. The observations ``seen`` and ``true`` are [E, steps + 1, ...] and begin
        with the first observation. ``action``, ``reward``, ``true_reward``, ``terminated``,
        ``truncated`` and, with a hidden variable, ``hidden`` are [E, steps, ...]. Entries after the
        end of an episode have no meaning.

    Raises:
        UserError: for an unsuitable environment, or a policy that does not fit it.
    """
    params = parameters_of(env, params)
    policy = checked(policy, env, params)
    make_room()
    types = node_types((policy, params))
    key, played = random_key(seed), []
    for count, part in parts_of(env, episodes):
        frames = _play(policy, env, params, key, count, steps, hidden, part, types)
        played.append({name: np.asarray(value) for name, value in frames.items()})
    if len(played) == 1:
        return played[0]
    return {name: np.concatenate([frames[name] for frames in played]) for name in played[0]}


@functools.partial(jax.jit, static_argnames=("env", "episodes", "steps", "hidden", "types"))
def _play(policy, env, params, key, episodes, steps, hidden, part, types):
    memory, state, first, step_key = begin_episodes(policy, env, params, key, episodes, part)
    true = None
    if hasattr(env, "true_observation"):
        with foreign_code():
            true = jax.vmap(env.true_observation, in_axes=(0, None))(state, params)

    def step(loop, time):
        memory, state, observation = loop
        action, memory = jax.vmap(policy.step)(memory, observation)
        met = None
        if hidden is not None:
            met = hidden(state.env if isinstance(env, Disturbed) else state)
        observation, state, reward, terminated, truncated, info = take_step(
            env, params, step_key, time, state, action, part
        )
        seen = info["final_observation"].astype(jnp.float32)
        frame = {
            "seen": seen,
            "action": action.reshape(episodes, -1).astype(jnp.float32),
            "reward": reward,
            "true_reward": jnp.asarray(info.get("true_reward", reward), jnp.float32),
            "terminated": terminated,
            "truncated": truncated,
        }
        if "true_observation" in info:
            frame["true"] = jnp.asarray(info["true_observation"], jnp.float32)
        if met is not None:
            frame["hidden"] = jnp.asarray(met, jnp.float32).reshape(episodes, -1)
        return (memory, state, observation), frame

    (_, state, _), frames = jax.lax.scan(
        step, (memory, state, first), jnp.arange(steps, dtype=jnp.int32), length=steps
    )
    release(env, state)
    frames = {name: jnp.swapaxes(value, 0, 1) for name, value in frames.items()}
    frames["seen"] = jnp.concatenate([first[:, None], frames["seen"]], axis=1)
    if "true" not in frames:
        return {**frames, "true": frames["seen"]}
    if true is None:
        true = jnp.full((episodes, frames["true"].shape[-1]), jnp.nan)
    frames["true"] = jnp.concatenate([true.astype(jnp.float32)[:, None], frames["true"]], axis=1)
    return frames


def _trajectory(
    played: dict[str, np.ndarray],
    env: EnvironmentLike,
    params: Any,
    drawing: Drawing,
    seed: int,
) -> Trajectory:
    """Cut at the longest episode, fill with NaN after the end of each, and name the elements."""
    done = played["terminated"] | played["truncated"]
    lengths = np.where(done.any(axis=1), done.argmax(axis=1) + 1, done.shape[1])
    most = int(lengths.max())

    def cut(name: str) -> np.ndarray:
        rows = most + (name in ("seen", "true"))
        values = played[name][:, :rows].copy()
        after = np.arange(rows) >= lengths[:, None] + (name in ("seen", "true"))
        values[after] = False if values.dtype == bool else np.nan
        return values

    names = element_names(drawing.observation, "o", played["true"].shape[-1])
    elements = seen_elements(env, params, len(names))
    size = played["seen"].shape[-1]
    met = "hidden" in played
    hidden: list[str] = []
    if met:
        hidden = element_names(drawing.hidden_elements, "", played["hidden"].shape[-1])
    own: Interface = describe(env, params)
    seconds = drawing.step_seconds
    base = params.env if isinstance(env, Disturbed) else params
    return Trajectory(
        seen=cut("seen"),
        true=cut("true"),
        actions=cut("action"),
        rewards=cut("reward"),
        true_rewards=cut("true_reward"),
        terminated=cut("terminated"),
        truncated=cut("truncated"),
        hidden=cut("hidden") if met else None,
        lengths=lengths.astype(np.int64),
        action_low=own.action_low,
        action_high=own.action_high,
        observation_names=tuple(names),
        seen_names=tuple(
            # Numbered names if it is not known which elements a process leaves.
            [names[k] for k in elements] if len(elements) == size else element_names((), "s", size)
        ),
        action_names=tuple(element_names(drawing.action, "a", played["action"].shape[-1])),
        hidden_names=tuple(f"{drawing.hidden_name} {name}" for name in hidden),
        environment=environment_name(env),
        seed=seed,
        step_seconds=None if seconds is None else float(getattr(base, seconds)),
    )


def element_names(given: tuple[str, ...], letter: str, size: int) -> list[str]:
    """The given names if their number equals ``size``; else numbered names."""
    if len(given) == size:
        return list(given)
    return [f"{letter}[{k}]" for k in range(size)]


def _named(what: str, names: tuple[str, ...], values: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of ``values`` [rows, elements] by name."""
    return {f"{what} {name}".strip(): values[:, k] for k, name in enumerate(names)}


def _row_more(values: np.ndarray, length: int) -> np.ndarray:
    """The first ``length`` rows, and a row of NaN."""
    shape = (1, *values.shape[1:])
    return np.concatenate([values[:length], np.full(shape, np.nan, np.float32)])
