"""Sizes and bounds of an environment, which are checked before anything is compiled."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.envs.entry import check_gymnax
from rtd3jax.errors import UserError, typed_reason
from rtd3jax.protocols import EnvironmentLike

MOST_BOUND = 1e20
"""An action bound of this size means "no limit": its square overflows float32."""


@dataclasses.dataclass(frozen=True, eq=False)
class Interface:
    """Sizes of observation and action, and bounds of the flat action [A]."""

    observation_size: int
    action_shape: tuple[int, ...]
    action_size: int
    action_low: np.ndarray
    """float32 [A]"""
    action_high: np.ndarray
    """float32 [A]"""
    true_observation_size: int = 0
    """S; 0 if the environment does not give the undisturbed observation"""

    @property
    def sizes(self) -> tuple[int, int]:
        """(O, A)"""
        return self.observation_size, self.action_size


@contextlib.contextmanager
def foreign_code() -> Iterator[None]:
    """Run code of an environment under JAX's standard promotion, even if the process is strict."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@dataclasses.dataclass(frozen=True, eq=False)
class Survey:
    """The result of tracing an environment; parts that could not be found are None."""

    interface: Interface | None
    problems: list[UserError]
    """In the order of the checks; an environment with a problem cannot be trained on."""
    reset: tuple[Any, Any] | None
    """Shapes of (observation, state)."""
    step: tuple | None
    """Shapes of the six values of step."""


def describe(env: EnvironmentLike, params: object) -> Interface:
    """Check that ``env`` is a gymnax >= 1.0 environment for training; return its sizes and bounds.

    The environment is traced, not compiled.

    Raises:
        UserError: naming the problem and its remedy.
    """
    found = survey(env, params)
    if found.problems:
        raise found.problems[0]
    assert found.reset is not None and found.step is not None and found.interface is not None
    for problem, remedy in changes_of_type("state", found.reset[1], found.step[1]):
        raise UserError(f"environment {environment_name(env)}: {problem}; {remedy}")
    return found.interface


def changes_of_type(what: str, before: object, after: object) -> Iterator[tuple[str, str]]:
    """Differences in type between the values of reset and step, each with its remedy.

    Args:
        what: the name of the value in the text.
        before: shapes of the value that reset returns.
        after: shapes of the value that step returns.
    """
    structures: list[Any] = [jax.tree.structure(before), jax.tree.structure(after)]
    if structures[0] != structures[1]:
        problem = f"reset and step return a {what} of different structure"
        yield problem, "return the same dataclass from both"
        return
    leaves = jax.tree_util.tree_leaves_with_path(before)
    for (path, leaf), new in zip(leaves, jax.tree.leaves(after), strict=True):
        if (leaf.dtype, leaf.shape) != (new.dtype, new.shape):
            where = f"{what}{jax.tree_util.keystr(path)}"
            yield (
                f"{where} is {leaf.dtype}{list(leaf.shape)} after reset and "
                f"{new.dtype}{list(new.shape)} after step",
                "loops and automatic resets need equal types: convert in both, "
                "e.g. jnp.float32(...)",
            )


def survey(env: EnvironmentLike, params: object) -> Survey:
    """All problems that `describe` can find, and the traced shapes."""
    name = environment_name(env)
    try:
        check_gymnax(env)
        check_hashable(env)
    except UserError as error:
        return Survey(None, [error], None, None)
    problems: list[UserError] = []

    def noted(call: Callable[[], Any]) -> Any:
        """The call's result; None if the call raised an error, which is then noted."""
        try:
            return call()
        except UserError as error:
            problems.append(error)
            return None

    with foreign_code():
        bounds = noted(lambda: _bounds(env, params, name))
        first = noted(lambda: trace_reset(env, params))
        if first is not None:
            noted(lambda: _check_observation(name, "reset", first[0]))
        if bounds is None or problems:
            return Survey(None, problems, first, None)
        shape, low, high = bounds
        after = noted(
            lambda: trace_step(env, params, first[1], jax.ShapeDtypeStruct(shape, jnp.float32))
        )
    if after is None:
        return Survey(None, problems, first, None)
    problems += _step_problems(name, after, first[0])
    size = first[0].shape[0]
    truth = _true_observation_size(env, after[5])
    return Survey(Interface(size, shape, low.size, low, high, truth), problems, first, after)


def check_hashable(env: object) -> None:
    """Raise UserError unless compiled programs can be kept for ``env``."""
    try:
        hash(env)
    except TypeError as error:
        raise UserError(
            f"environment {environment_name(env)} cannot be hashed ({error}): make it a "
            "@dataclass(frozen=True), or @dataclass(eq=False), or inherit from rtd.ValueIdentity"
        ) from error


def _true_observation_size(env: object, info: object) -> int:
    """S, if the environment gives the undisturbed observation of a state and in info; else 0."""
    told = info.get("true_observation") if isinstance(info, dict) else None
    shape: tuple[int, ...] = getattr(told, "shape", ())
    return shape[0] if hasattr(env, "true_observation") and len(shape) == 1 else 0


def trace_reset(env: EnvironmentLike, params: object) -> tuple[Any, Any]:
    """Shapes of the two values of reset; UserError if reset fails or returns other values."""
    name, key = environment_name(env), jax.eval_shape(lambda: jax.random.key(0))
    with foreign_code():
        first = _attempt(name, "reset", lambda: jax.eval_shape(env.reset, key, params))
    if not isinstance(first, tuple) or len(first) != 2:
        raise UserError(f"environment {name}: reset must return (observation, state)")
    return first


def trace_step(
    env: EnvironmentLike, params: object, state: object, action: jax.ShapeDtypeStruct
) -> tuple:
    """Shapes of the six values of step; UserError if step fails or returns other values."""
    name, key = environment_name(env), jax.eval_shape(lambda: jax.random.key(0))
    with foreign_code():
        after = _attempt(name, "step", lambda: jax.eval_shape(env.step, key, state, action, params))
    count = len(after) if isinstance(after, tuple) else 1
    if count == 5:
        raise UserError(
            f"environment {name}: step returns five values, as before gymnax 1.0; upgrade it to "
            "return (observation, state, reward, terminated, truncated, info)"
        )
    if count != 6:
        raise UserError(
            f"environment {name}: step returns {count} values instead of the six of gymnax >= 1.0 "
            "(observation, state, reward, terminated, truncated, info)"
        )
    return after


def action_bounds(env: EnvironmentLike, params: object) -> tuple[jax.Array, jax.Array]:
    """Lowest and highest flat action, [A] each; ``params`` may be traced."""
    with foreign_code():
        space = env.action_space(params)
        low, high = (
            jnp.broadcast_to(jnp.asarray(bound, jnp.float32), space.shape).reshape(-1)
            for bound in (space.low, space.high)
        )
    return low, high


def environment_name(env: object) -> str:
    """The name used in messages."""
    try:
        return str(getattr(env, "name", type(env).__name__))
    except Exception:  # the name is for messages only: an error in it must not hide the message
        return type(env).__name__


def _attempt(name: str, what: str, call: Callable[[], Any]) -> Any:
    """Run code of an environment; turn its errors into a one-line UserError."""
    try:
        return call()
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"environment {name} failed in {what}: {typed_reason(error)}") from error


def _bounds(
    env: EnvironmentLike, params: object, name: str
) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
    """Shape of an action, and its bounds [A]."""
    space = _attempt(name, "action_space", lambda: env.action_space(params))
    if hasattr(space, "n"):
        raise UserError(
            f"environment {name} has discrete actions; rtd3jax needs continuous actions: "
            "choose an environment whose action space is a bounded Box"
        )
    if not all(hasattr(space, field) for field in ("low", "high", "shape")):
        raise UserError(
            f"environment {name}: the action space {type(space).__name__} is not a Box; "
            "flatten the action into one bounded Box"
        )
    low, high = _attempt(
        name, "action_space", lambda: [np.asarray(b) for b in action_bounds(env, params)]
    )
    if not (np.all(np.isfinite(low)) and np.all(np.isfinite(high))):
        raise UserError(
            f"environment {name}: the action space is unbounded; give its Box finite low and high"
        )
    largest = max(np.max(np.abs(low), initial=0.0), np.max(np.abs(high), initial=0.0))
    with np.errstate(over="ignore"):
        countable = bool(np.all(np.isfinite(high - low)))
    if largest >= MOST_BOUND or not countable:
        raise UserError(
            f"environment {name}: the action's bounds reach {largest:.3g}, too large for "
            "float32; if they stand for 'no limit', give the Box the range that the plant can use"
        )
    if low.size == 0 or not np.all(low < high):
        raise UserError(f"environment {name}: the action space needs low < high in every element")
    return tuple(space.shape), low, high


def _check_observation(name: str, what: str, observation: Any) -> None:
    if not hasattr(observation, "dtype"):
        raise UserError(
            f"environment {name}: the observation of {what} is a {type(observation).__name__}; "
            "concatenate its parts into one float array"
        )
    if not jnp.issubdtype(observation.dtype, jnp.floating):
        raise UserError(
            f"environment {name}: the observation of {what} is {observation.dtype}; "
            "convert it to float32"
        )
    if len(observation.shape) != 1:
        raise UserError(
            f"environment {name}: the observation of {what} has shape {observation.shape}; "
            "flatten it to one dimension"
        )


def _step_problems(
    name: str, after: tuple, first_observation: jax.ShapeDtypeStruct
) -> Iterator[UserError]:
    """The problems of the six values of step."""
    observation, _, reward, terminated, truncated, info = after
    try:
        _check_observation(name, "step", observation)
    except UserError as error:
        yield error
        return
    if observation.shape != first_observation.shape:
        yield UserError(
            f"environment {name}: observations of step and reset have shapes "
            f"{observation.shape} and {first_observation.shape}; make them the same"
        )
    for what, value in (("reward", reward), ("terminated", terminated), ("truncated", truncated)):
        if getattr(value, "shape", None) != ():
            yield UserError(
                f"environment {name}: {what} must be a scalar, not of shape "
                f"{getattr(value, 'shape', type(value).__name__)}; return one number per step"
            )
    try:
        check_final_observation(name, info, observation)
    except UserError as error:
        yield error


def check_final_observation(name: str, info: object, observation: jax.ShapeDtypeStruct) -> None:
    """Raise UserError unless ``info`` has the observation before the automatic reset."""
    if not isinstance(info, dict) or "final_observation" not in info:
        raise UserError(
            f"environment {name}: info lacks 'final_observation', the observation before the "
            "automatic reset; inherit step from gymnax >= 1.0's Environment"
        )
    final = info["final_observation"]
    if getattr(final, "shape", None) != observation.shape:
        raise UserError(
            f"environment {name}: info['final_observation'] must have the observation's shape "
            f"{observation.shape}"
        )
