"""Whether a policy and an environment fit each other: asked wherever the two meet."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.errors import UserError
from rtd3jax.protocols import PolicyLike


def check_compatible(
    policy: PolicyLike,
    observation_size: int,
    action_shape: tuple[int, ...],
    low: np.ndarray,
    high: np.ndarray,
) -> None:
    """Compare what a policy was made for with an environment; warns of other bounds.

    Args:
        policy: anything with ``init`` and ``step``.
        observation_size: elements of the environment's observation.
        action_shape: of its action.
        low: its lowest action, of any shape with as many elements.
        high: its highest.

    Raises:
        UserError: naming both shapes, where observations or actions differ.
    """
    if not (callable(getattr(policy, "init", None)) and callable(getattr(policy, "step", None))):
        raise UserError(f"{type(policy).__name__} is not a policy: it needs init and step")
    remedy = "use it on the kind of environment that it was made for"
    expected = getattr(policy, "observation_size", observation_size)
    if expected != observation_size:
        raise UserError(
            f"the policy expects {expected} observation elements, the environment gives "
            f"{observation_size}: {remedy}"
        )
    constant = getattr(policy, "action", None)
    given = _action_shape(policy, observation_size)
    if isinstance(constant, jax.Array) and constant.size == int(np.prod(action_shape)):
        return  # a constant is given flat
    if given is not None and given != action_shape:
        raise UserError(
            f"the policy's action has shape {given}, the environment's {action_shape}: {remedy}"
        )
    _warn_of_bounds(policy, low, high)


def _action_shape(policy: PolicyLike, observation_size: int) -> tuple[int, ...] | None:
    """The shape of the policy's action; None where it cannot be found out without playing."""
    if hasattr(policy, "action_shape"):
        return tuple(policy.action_shape)
    seen = jax.ShapeDtypeStruct((observation_size,), jnp.float32)
    key = jax.eval_shape(lambda: jax.random.key(0))
    try:
        traced = jax.eval_shape(lambda k, o: policy.step(policy.init(k), o)[0], key, seen)
    except UserError:
        raise
    except Exception:  # a policy that cannot be traced says so itself when it is played
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
            "mean another thing there",
            stacklevel=4,
        )
