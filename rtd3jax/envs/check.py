"""Finds common errors of an environment by playing it."""

import contextlib
import dataclasses
import functools
import warnings
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from rtd3jax.envs.compat.simulated import fleet_of
from rtd3jax.envs.compat.simulator import fault_of
from rtd3jax.envs.compat.simulator_state import simulator_handles, without_handles
from rtd3jax.envs.entry import DEFAULT_STEP_LIMIT, parameters_of
from rtd3jax.envs.interface import (
    Interface,
    Survey,
    changes_of_type,
    environment_name,
    foreign_code,
    survey,
)
from rtd3jax.errors import UserError, typed_reason
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.system.numbers import check_count

EPISODES = 8
LONGEST_EPISODE = 1_000
"""Steps of an episode that are played; the rest of a longer episode is not checked."""

LARGEST, SMALLEST = 1e2, 1e-3
"""A network learns well from numbers whose root mean square lies between these bounds."""

_DIGITS = 1e-5
"""Largest relative difference that counts as the rounding of two compilations of one program."""

AFTER_RESET = 8
"""Steps for which `_leaks` compares two new episodes."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """One problem of an environment and its remedy, each in one line.

    Attributes:
        kind: ``interface`` (every training refuses the environment), ``dtype``, ``space``,
            ``vmap``, ``simulator``, ``finite``, ``pure``, ``leak``, ``final-observation``,
            ``time-limit``, or ``scale``.
        problem: what is wrong.
        remedy: what to do.
        advice: true if the environment is correct, but training on it will probably be poor.
    """

    kind: str
    problem: str
    remedy: str
    advice: bool = False

    def __str__(self) -> str:
        """The problem and its remedy."""
        return f"{self.problem}; {self.remedy}" if self.remedy else self.problem


def check_env(env: EnvironmentLike, *, params: object = None, seed: int = 0) -> None:
    """Play ``env`` with random actions, and raise an error if it has a problem.

    Eight episodes are played to their end, but for at most 1,000 steps; the environment is compiled
    for this. A finding that is only advice is given as a warning.

    Args:
        env: a gymnax >= 1.0 environment.
        params: the environment's parameters; its default parameters by default.
        seed: seed of the episodes and actions.

    Raises:
        UserError: for an impossible seed; or listing every `Finding` that is not advice, with its
            remedy; several findings are on separate lines.
    """
    found, name = _findings(env, params, seed), environment_name(env)
    for finding in found:
        if finding.advice:
            warnings.warn(f"environment {name}: {finding}", stacklevel=2)
    findings = [finding for finding in found if not finding.advice]
    if findings:
        lines = [str(finding) for finding in findings]
        if len(lines) == 1:
            kind_of_prefix = f"environment {name}"
            line = lines[0]
            raise UserError(
                line if line.startswith(kind_of_prefix) else f"{kind_of_prefix}: {line}"
            )
        raise UserError(
            f"environment {name} has {len(lines)} problems:\n"
            + "\n".join(f"  {number}. {line}" for number, line in enumerate(lines, 1))
        )


def find_problems(env: EnvironmentLike, *, params: object = None, seed: int = 0) -> list[Finding]:
    """The findings of `check_env` except advice; an empty list for a correct environment."""
    return [finding for finding in _findings(env, params, seed) if not finding.advice]


def _findings(env: Any, params: Any, seed: int) -> list[Finding]:
    """All findings, advice included; UserError for an impossible seed."""
    check_count("seed", seed, 0)
    try:
        params = parameters_of(env, params)
    except UserError as error:
        return [Finding("interface", str(error), "")]
    found = survey(env, params)
    findings = [Finding("interface", str(error), "") for error in found.problems]
    if found.reset is None or found.step is None:
        return findings
    findings += _dtypes(found)
    findings += _spaces(env, params, found)
    if findings:  # the other checks would fail for the same reason
        return findings
    assert found.interface is not None
    fleet = fleet_of(env)
    with foreign_code(), contextlib.nullcontext() if fleet is None else fleet.for_a_while():
        # JAX's default type of an integer cannot hold all seeds.
        played = _played(env, params, found.interface, np.uint32(seed))
        return [*_whole_actions(env, params), *played]


def _dtypes(found: Survey) -> Iterator[Finding]:
    """Finds arrays whose type changes between reset and step."""
    assert found.reset is not None and found.step is not None
    before, after = found.reset, found.step[:2]
    for what, one, other in zip(("observation", "state"), before, after, strict=True):
        for problem, remedy in changes_of_type(what, one, other):
            yield Finding("dtype", problem, remedy)


def _spaces(env: EnvironmentLike, params: object, found: Survey) -> Iterator[Finding]:
    """Finds an observation space that disagrees with the observations."""
    assert found.reset is not None
    declaring: Any = env
    try:
        space = declaring.observation_space(params)
    except Exception:  # an environment need not declare a space
        return
    shape = tuple(getattr(space, "shape", None) or ())
    if shape != found.reset[0].shape:
        yield Finding(
            "space",
            f"observation_space has shape {shape}, but the observation has {found.reset[0].shape}",
            "make observation_space(params) describe what reset and step return",
        )


def _whole_actions(env: EnvironmentLike, params: object) -> Iterator[Finding]:
    """Advice for an environment whose actions are whole numbers."""
    dtype = getattr(env.action_space(params), "dtype", None)
    if dtype is not None and jnp.issubdtype(dtype, jnp.integer):
        yield Finding(
            "space",
            f"action_space is a Box of {np.dtype(dtype)}, but agents choose real numbers between "
            "its bounds, which step receives without rounding",
            "round the action in step_env, or give the Box a float dtype",
            advice=True,
        )


def _played(
    env: EnvironmentLike, params: object, interface: Interface, seed: np.uint32
) -> Iterator[Finding]:
    """Finds problems that only appear when the environment is played."""
    limit = getattr(params, "max_steps_in_episode", None)
    steps = int(min(LONGEST_EPISODE, DEFAULT_STEP_LIMIT if limit is None else limit))
    try:
        record = _episodes(env, params, interface, seed, steps)
    except Exception as error:
        yield Finding(
            "vmap",
            f"the environment cannot be vmapped: {typed_reason(error)}",
            "write reset and step for one environment, with only jax.numpy; "
            "a pure_callback needs a vmap_method",
        )
        return
    yield from _finite(record)
    yield from _scales(record)
    yield from _time_limits(record, limit, steps)
    yield from _final_observations(record)
    impure = list(_pure(env, params, record, seed))
    yield from impure
    if not impure:  # episodes of an impure environment cannot be compared
        yield from _leaks(env, params, record, seed)


@dataclasses.dataclass
class _Record:
    """T steps of E = 8 copies of the environment; numpy arrays, except for the states.

    When an episode ends, the automatic reset begins another one.

    Attributes:
        first: [E, O], the observations of reset.
        seen, final: [E, T, O], the observations of step, and ``final_observation`` of info.
        reward, terminated, truncated: [E, T].
        last_state: [E, ...], the state before the last played step of the first episode.
        last_action: [E, ...], the action of this step.
    """

    first: np.ndarray
    seen: np.ndarray
    final: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    last_state: Any
    last_action: Any

    @property
    def length(self) -> np.ndarray:
        """int [E], steps of the first episode; T + 1 if it did not end."""
        done = self.terminated | self.truncated
        return np.where(done.any(1), done.argmax(1) + 1, done.shape[1] + 1)

    @property
    def ended(self) -> np.ndarray:
        """bool [E]: whether the first episode ended."""
        return (self.terminated | self.truncated).any(1)


def _episodes(
    env: EnvironmentLike, params: object, interface: Interface, seed: np.uint32, steps: int
) -> _Record:
    def episode(key: jax.Array, keys: jax.Array, actions: jax.Array, params: object) -> tuple:
        first, state = env.reset(key, params)
        actions = actions.reshape(steps, *interface.action_shape)

        def step(carry: tuple, inputs: tuple) -> tuple:
            state, last_state, last_action, ended = carry
            key, action = inputs
            last_state = jax.tree.map(
                lambda old, new: jnp.where(ended, old, new), last_state, state
            )
            last_action = jnp.where(ended, last_action, action)
            seen, state, reward, terminated, truncated, info = env.step(key, state, action, params)
            terminated, truncated = jnp.asarray(terminated, bool), jnp.asarray(truncated, bool)
            out = (seen, info["final_observation"], reward, terminated, truncated)
            return (state, last_state, last_action, ended | terminated | truncated), out

        start = (state, state, actions[0], jnp.array(False))
        played: Any = jax.lax.scan(step, start, (keys, actions))
        (_, last_state, last_action, _), out = played
        return first, *out, last_state, last_action

    draws = _draw(seed, interface.action_low, interface.action_high, steps)
    played = jax.jit(jax.vmap(episode, in_axes=(0, 0, 0, None)))(*draws, params)
    return _Record(*(np.asarray(part) for part in played[:6]), *played[6:])


@functools.partial(jax.jit, static_argnames="steps")
def _draw(
    seed: jax.Array | np.uint32, low: jax.Array, high: jax.Array, steps: int
) -> tuple[jax.Array, ...]:
    """Keys of resets [E] and steps [E, T], and actions [E, T, A]; compiled only once."""
    key_resets, key_steps, key_actions = jax.random.split(jax.random.key(seed), 3)
    shape = (EPISODES, steps)
    actions = jax.random.uniform(key_actions, (*shape, *low.shape), jnp.float32, low, high)
    return jax.random.split(key_resets, EPISODES), jax.random.split(key_steps, shape), actions


def _finite(record: _Record) -> Iterator[Finding]:
    """Finds infinities and NaN in the episodes."""
    faults = map(fault_of, simulator_handles(record.last_state))
    if fault := next(filter(None, faults), None):
        yield Finding("simulator", fault, "make reset and step as Gymnasium's Env describes them")
        return
    remedy = "look for a division by zero, a logarithm, or a state that grows without bound"
    if not np.all(np.isfinite(record.first)):
        yield Finding("finite", "the observation of reset is not finite", remedy)
        return
    for what, values in (("observation", record.final), ("reward", record.reward)):
        good = np.isfinite(values.reshape(*values.shape[:2], -1)).all(-1)
        if not good.all():
            step = int(np.argmin(good.all(0)))
            yield Finding("finite", f"the {what} of step {step} is not finite", remedy)


def _scales(record: _Record) -> Iterator[Finding]:
    """Finds observations and rewards that are too large or too small for a network."""

    def far(size: np.ndarray | float) -> np.ndarray:
        size = np.asarray(size)
        return ((size > LARGEST) & (size < np.inf)) | ((size > 0) & (size < SMALLEST))

    seen = record.final.reshape(-1, record.final.shape[-1]).astype(np.float64)
    sizes = np.sqrt(np.mean(seen**2, axis=0))
    odd = np.flatnonzero(far(sizes))
    if odd.size:
        few = ", ".join(f"element {k} {sizes[k]:.1g}" for k in odd[:3])
        more = f", and {odd.size - 3} more" if odd.size > 3 else ""
        yield Finding(
            "scale",
            f"root mean squares of the observation are far from one: {few}{more}",
            "train with normalise_observations=True (--normalise-observations), or divide each "
            "element by its usual size",
            advice=True,
        )
    size = float(np.sqrt(np.mean(record.reward.astype(np.float64) ** 2)))
    if far(size):
        yield Finding(
            "scale",
            f"rewards of {size:.1g} are far from one",
            f"train with reward_scale={1 / size:.1g}; returns are reported without this factor",
            advice=True,
        )


def _pure(
    env: EnvironmentLike, params: object, record: _Record, seed: np.uint32
) -> Iterator[Finding]:
    """Finds a reset or a step whose result changes for equal arguments."""
    state, action = _first((record.last_state, record.last_action))

    def both() -> tuple:
        key = jax.random.key(seed)
        return env.reset(key, params), env.step(key, state, action, params)

    results = []
    # The setting changes no number here. But it is part of the key under which JAX caches programs,
    # so JAX runs the Python code again. A result that depends on other values than the arguments
    # then differs.
    for rank_promotion in ("allow", "warn"):
        with warnings.catch_warnings(), jax.numpy_rank_promotion(rank_promotion):
            warnings.simplefilter("ignore")
            program = jax.jit(lambda: both())
            results += [without_handles(program()), without_handles(program())]
    for index, what in enumerate(("reset", "step")):
        if not all(_equal(results[0][index], other[index]) for other in results[1:]):
            yield Finding(
                "pure",
                f"{what} gives different results for the same key, state and action",
                "keep every variable in the state, and draw with jax.random from the key",
            )
            return  # step contains the automatic reset: one finding is enough


def _time_limits(record: _Record, limit: int | None, steps: int) -> Iterator[Finding]:
    """Finds a time limit that is reported as a termination, or has no effect."""
    longest = steps + 1 if limit is None else int(limit)
    known = longest <= steps
    # Not with the limit of the parameters: the environment may end its episodes before.
    at_limit: np.ndarray = record.length == record.length[0]
    last = np.minimum(record.length, record.terminated.shape[1]) - 1
    terminated = record.terminated[np.arange(EPISODES), last]
    if record.ended.all() and at_limit.all() and terminated.all() and record.length[0] > 1:
        yield Finding(
            "time-limit",
            f"all {EPISODES} episodes terminate at step {record.length[0]}: that is a time limit",
            "report it as truncated, so that values are bootstrapped there: use gymnax's "
            "is_truncated and params.max_steps_in_episode",
        )
    elif known and (record.length > longest).any():
        yield Finding(
            "time-limit",
            f"an episode continues after params.max_steps_in_episode = {longest} steps",
            "count the steps in state.time, which gymnax's is_truncated reads",
        )
    elif (record.length == 1).all() and not terminated.any():
        yield Finding(
            "time-limit",
            f"a time limit ends all {EPISODES} episodes at their first step",
            "a memory is then never trained on a second step, and values may grow without bound: "
            "report the end as terminated if no reward can follow, make episodes longer, or train "
            "td3, or with gamma=0",
            advice=True,
        )


def _final_observations(record: _Record) -> Iterator[Finding]:
    """Finds a ``final_observation`` that is not the observation before the automatic reset."""
    done = record.terminated | record.truncated
    # XLA may compute the two observations in different fusions, so their last digits may differ.
    # `_finite` reports infinite observations.
    size = np.max(np.abs(record.final), axis=(0, 1), initial=0.0, where=np.isfinite(record.final))
    alike = np.isclose(record.final, record.seen, rtol=0, atol=_DIGITS * size, equal_nan=True)
    inside, same = ~done, np.all(alike, axis=-1)
    moving = np.nan_to_num(np.ptp(record.final, axis=1)).max() > 0
    if not same[inside].all():
        yield Finding(
            "final-observation",
            "info['final_observation'] differs from the observation during an episode",
            "return the observation before the automatic reset, at every step",
        )
    elif done.any() and moving and same[done].all():
        yield Finding(
            "final-observation",
            "info['final_observation'] of an ended episode is the next episode's first observation",
            "return the observation before the automatic reset",
        )


def _leaks(
    env: EnvironmentLike, params: object, record: _Record, seed: np.uint32
) -> Iterator[Finding]:
    """Finds an episode that depends on the previous episode.

    Two different episodes end with the same key, so the automatic resets draw the same random
    numbers. From then on both get the same keys and actions, so their observations must be equal.
    """
    pairs = np.flatnonzero(record.ended)[:2]
    if len(pairs) < 2:
        return

    def go_on(state: object, action: jax.Array, params: object) -> tuple:
        key = jax.random.key(seed)
        first, state, _, terminated, truncated, _ = env.step(key, state, action, params)

        def step(state: object, key: jax.Array) -> tuple:
            seen, state, reward, *_ = env.step(key, state, _first(record.last_action), params)
            return state, (seen, reward)

        played: Any = jax.lax.scan(step, state, jax.random.split(key, AFTER_RESET))
        return jnp.asarray(terminated, bool) | jnp.asarray(truncated, bool), first, *played[1]

    both = jax.tree.map(lambda leaf: leaf[pairs], (record.last_state, record.last_action))
    done, *new = jax.jit(jax.vmap(go_on, in_axes=(0, 0, None)))(*both, params)
    if np.all(done) and not all(_close(part[0], part[1]) for part in new):
        yield Finding(
            "leak",
            "an episode depends on the previous one: reset does not restore the whole state",
            "create the whole state in reset_env, and let no wrapper keep parts of the old state",
        )


def _first(tree: object) -> Any:
    return jax.tree.map(lambda leaf: leaf[0], tree)


def _close(one: ArrayLike, other: ArrayLike) -> bool:
    return np.allclose(np.asarray(one), np.asarray(other), rtol=1e-5, atol=1e-6, equal_nan=True)


def _equal(one: object, other: object) -> bool:
    """Whether two results are equal, except for the rounding of two compilations.

    XLA may fuse a program in two ways, whose last digits differ. The tolerance is relative to the
    largest number of an array, in float32; integers and random keys have no tolerance. NaN equals
    NaN.
    """

    def same(a: jax.Array, b: jax.Array) -> bool:
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        if not jnp.issubdtype(a.dtype, jnp.inexact):
            return np.array_equal(np.asarray(a), np.asarray(b))
        first, second = (np.asarray(array).astype(np.float64) for array in (a, b))
        size = np.max(np.abs(first), initial=0.0, where=np.isfinite(first))
        return np.allclose(first, second, rtol=_DIGITS, atol=_DIGITS * size, equal_nan=True)

    return all(map(same, jax.tree.leaves(one), jax.tree.leaves(other)))
