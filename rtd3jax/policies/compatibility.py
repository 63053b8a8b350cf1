"""Checks that a policy fits an environment."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.errors import UserError, short_reason
from rtd3jax.protocols import PolicyLike


def check_compatible(
    policy: PolicyLike,
    observation_size: int,
    action_shape: tuple[int, ...],
    low: np.ndarray,
    high: np.ndarray,
) -> None:
    """Check that a policy fits the sizes of an environment; warn if action bounds differ.

    Args:
        policy: anything with ``init`` and ``step``.
        observation_size: elements of the environment's observation.
        action_shape: shape of the environment's action.
        low: lowest action; any shape with the same number of elements.
        high: highest action; any shape with the same number of elements.

    Raises:
        UserError: if ``policy`` is not a policy, or JAX cannot compile it; naming both shapes, if
            observations or actions differ.
    """
    if not (callable(getattr(policy, "init", None)) and callable(getattr(policy, "step", None))):
        raise UserError(f"{type(policy).__name__} is not a policy: it needs init and step")
    _check_compilable(policy)
    remedy = "use the policy in the kind of environment that it was made for"
    expected = getattr(policy, "observation_size", observation_size)
    if expected != observation_size:
        raise UserError(
            f"the policy expects {expected} observation elements, the environment gives "
            f"{observation_size}: {remedy}"
        )
    given = _action_shape(fitted(policy, action_shape), observation_size)
    if given is not None and given != action_shape:
        raise UserError(
            f"the policy's action has shape {given}, the environment's {action_shape}: {remedy}"
        )
    _warn_of_bounds(policy, low, high)


def fitted(policy: PolicyLike, action_shape: tuple[int, ...]) -> Any:
    """``policy``, with actions of the environment's shape if it has ``with_action_shape``."""
    if callable(reshaped := getattr(policy, "with_action_shape", None)):
        return reshaped(action_shape)
    return policy


def _check_compilable(policy: PolicyLike) -> None:
    """Raise UserError unless JAX can pass the policy to a compiled function."""
    if isinstance(policy, type):
        raise UserError(f"{policy.__name__} is a class; pass an instance of it")
    try:
        jax.eval_shape(lambda _: None, policy)
    except TypeError as error:
        raise UserError(
            f"{type(policy).__name__} cannot be compiled; make it a flax.struct.dataclass: "
            f"{short_reason(error)}"
        ) from error


def _action_shape(policy: PolicyLike, observation_size: int) -> tuple[int, ...] | None:
    """The shape of the policy's action; None if it is not known before the policy is played."""
    if hasattr(policy, "action_shape"):
        return tuple(policy.action_shape)
    seen = jax.ShapeDtypeStruct((observation_size,), jnp.float32)
    key = jax.eval_shape(lambda: jax.random.key(0))
    try:
        traced = jax.eval_shape(lambda k, o: policy.step(policy.init(k), o)[0], key, seen)
    except UserError:
        raise
    except Exception:  # a policy that cannot be traced raises this error later, when it is played
        return None
    return getattr(traced, "shape", None)


def _warn_of_bounds(policy: PolicyLike, low: np.ndarray, high: np.ndarray) -> None:
    bounds = getattr(policy, "bounds", None)
    if bounds is None or isinstance(bounds.low, jax.core.Tracer):
        return
    own = [np.asarray(bound, np.float32).reshape(-1) for bound in (bounds.low, bounds.high)]
    there = [np.asarray(bound, np.float32).reshape(-1) for bound in (low, high)]
    same = all(
        a.size == b.size and np.allclose(a, b, rtol=1e-5, atol=0)
        for a, b in zip(own, there, strict=True)
    )
    if not same:
        warnings.warn(
            f"the policy's actions go from {own[0].tolist()} to {own[1].tolist()}, the "
            f"environment's from {there[0].tolist()} to {there[1].tolist()}: the same command may "
            "have another effect there",
            stacklevel=4,
        )
