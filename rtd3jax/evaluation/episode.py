"""Episodes of a policy, step by step: to look at, to plot, to put in a table."""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.envs.description import Drawing
from rtd3jax.envs.disturbed import Disturbed, seen_elements
from rtd3jax.envs.entry import parameters_of
from rtd3jax.envs.interface import (
    DEFAULT_STEP_LIMIT,
    Interface,
    describe,
    environment_name,
    foreign_code,
)
from rtd3jax.envs.registry import description_of
from rtd3jax.errors import UserError
from rtd3jax.policies.compatibility import check_compatible
from rtd3jax.protocols import EnvironmentLike, PolicyLike
from rtd3jax.system.program_cache import make_room

if TYPE_CHECKING:  # with it come a second of imports
    import pandas as pd


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectory:
    """Episodes as arrays: E episodes, T steps of the longest of them.

    What comes after an episode's own end is NaN, or False. Row t of the observations is what there
    was when action t was chosen; row ``lengths`` is the last one, after which nothing was done.

    Attributes:
        seen: float32 [E, T + 1, O], what the policy saw.
        true: float32 [E, T + 1, S], the undisturbed observation; NaN in row 0 where the environment
            does not tell it.
        actions: float32 [E, T, A], flat, in the environment's units.
        rewards: float32 [E, T], as given.
        true_rewards: float32 [E, T], of the undisturbed state where the environment tells it.
        terminated: bool [E, T], the episode ended by itself after this step.
        truncated: bool [E, T], the time limit was reached after this step.
        hidden: float32 [E, T, K], what action t met unseen; None where the environment's `Drawing`
            names no such thing.
        lengths: int64 [E], steps of each episode.
        action_low: float32 [A], the lowest action.
        action_high: float32 [A], the highest action.
        observation_names: S names of the undisturbed observation's elements.
        seen_names: O names of the elements that the policy saw.
        action_names: A names.
        hidden_names: K names.
        environment: its name.
        seed: of the episodes.
        step_seconds: length of a step in s; None where that is not known.
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
        """Sums of the rewards as given, float32 [E]."""
        return np.nansum(self.rewards, axis=1)

    def to_frame(self) -> "pd.DataFrame":
        """A row for each observation of each episode.

        Columns: ``episode``, ``step``, ``time`` (s, where a step's length is known), ``seen X`` and
        ``true X`` for each element of the observation, ``action X``, ``reward``, ``true reward``,
        ``terminated``, ``truncated``, and the names of the hidden signal, such as ``slip left``.
        The last row of an episode has its last observation, and NaN for the action that nobody
        chose and all that would have followed from it.
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
    """Play ``episodes`` of ``policy``, and keep every step.

    They are those of ``rtd.evaluate(policy, env, episodes, seed)``: the same starts and the same
    disturbances.

    Args:
        policy: anything with ``init`` and ``step``; see `rtd3jax.policies`.
        env: a gymnax >= 1.0 environment. Names of elements and the hidden signal are those of the
            `Drawing` with which it was registered.
        seed: of the environment's streams.
        episodes: how many, side by side.
        params: the environment's parameters; its own by default.
        steps: cut episodes after so many; by default their own time limit.

    Raises:
        UserError: for an unfit environment or impossible arguments.
    """
    params = parameters_of(env, params)
    limit = int(getattr(params, "max_steps_in_episode", DEFAULT_STEP_LIMIT))
    steps = limit if steps is None else steps
    for name, value, low in (("episodes", episodes, 1), ("seed", seed, 0), ("steps", steps, 1)):
        if isinstance(value, bool) or value != int(value) or not low <= value < 2**32:
            raise UserError(f"{name} must be an integer of at least {low}, not {value!r}")
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
    """Play ``steps`` of each episode, with ``hidden`` of a `Drawing`: arrays [episodes, ...].

    Observations ``seen`` and ``true`` [E, steps + 1, ...] begin with the first one; ``action``,
    ``reward``, ``true_reward``, ``terminated``, ``truncated`` and, where there is such a thing,
    ``hidden`` are [E, steps, ...]. Whatever comes after an episode's end means nothing.

    Raises:
        UserError: for an unfit environment, or a policy that does not fit it.
    """
    params = parameters_of(env, params)
    own = describe(env, params)
    check_compatible(
        policy, own.observation_size, own.action_shape, own.action_low, own.action_high
    )
    make_room()
    frames = _play(policy, env, params, jax.random.key(seed), episodes, steps, hidden)
    return {name: np.asarray(value) for name, value in frames.items()}


@functools.partial(jax.jit, static_argnames=("env", "episodes", "steps", "hidden"))
def _play(policy, env, params, key, episodes, steps, hidden):
    # The keys are those of `rtd3jax.evaluation.rollout`, so that the episodes are the same.
    policy_key, reset_key, step_key = jax.random.split(key, 3)
    reset_keys = jax.random.split(reset_key, episodes)
    with foreign_code():
        observation, state = jax.vmap(env.reset, in_axes=(0, None))(reset_keys, params)
    memory = jax.vmap(policy.init)(jax.random.split(policy_key, episodes))
    first = observation.astype(jnp.float32)

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
            "action": action.reshape(episodes, -1).astype(jnp.float32),
            "reward": reward.astype(jnp.float32),
            "true_reward": jnp.asarray(info.get("true_reward", reward), jnp.float32),
            "terminated": terminated.astype(bool),
            "truncated": truncated.astype(bool),
        }
        if "true_observation" in info:
            frame["true"] = jnp.asarray(info["true_observation"], jnp.float32)
        if met is not None:
            frame["hidden"] = jnp.asarray(met, jnp.float32).reshape(episodes, -1)
        return (memory, state, observation.astype(jnp.float32)), frame

    _, frames = jax.lax.scan(
        step, (memory, state, first), jnp.arange(steps, dtype=jnp.int32), length=steps
    )
    frames = {name: jnp.swapaxes(value, 0, 1) for name, value in frames.items()}
    frames["seen"] = jnp.concatenate([first[:, None], frames["seen"]], axis=1)
    if "true" not in frames:
        return {**frames, "true": frames["seen"]}
    if isinstance(env, Disturbed):
        true, _ = jax.vmap(env.undisturbed_reset, in_axes=(0, None))(reset_keys, params)
    else:  # an environment that disturbs itself does not say what its first observation hides
        true = jnp.full((episodes, frames["true"].shape[-1]), jnp.nan, jnp.float32)
    frames["true"] = jnp.concatenate([true[:, None], frames["true"]], axis=1)
    return frames


def _trajectory(
    played: dict[str, np.ndarray],
    env: EnvironmentLike,
    params: Any,
    drawing: Drawing,
    seed: int,
) -> Trajectory:
    """Cut at the longest episode, blank what comes after each one's end, and name the elements."""
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
            [names[k] for k in elements] if len(elements) == size else element_names((), "o", size)
        ),
        action_names=tuple(element_names(drawing.action, "a", played["action"].shape[-1])),
        hidden_names=tuple(f"{drawing.hidden_name} {name}" for name in hidden),
        environment=environment_name(env),
        seed=seed,
        step_seconds=None if seconds is None else float(getattr(base, seconds)),
    )


def element_names(given: tuple[str, ...], letter: str, size: int) -> list[str]:
    """The names given, if there are as many as elements; else numbered ones."""
    if len(given) == size:
        return list(given)
    return [f"{letter}[{k}]" for k in range(size)]


def _named(what: str, names: tuple[str, ...], values: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of ``values`` [rows, elements] by name."""
    return {f"{what} {name}".strip(): values[:, k] for k, name in enumerate(names)}


def _row_more(values: np.ndarray, length: int) -> np.ndarray:
    """The first ``length`` rows, and one of NaN."""
    shape = (1, *values.shape[1:])
    return np.concatenate([values[:length], np.full(shape, np.nan, np.float32)])
