"""The linear-quadratic regulator of an environment."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike

from rtd3jax.envs.controllers.linear import linearised
from rtd3jax.envs.entry import parameters_of
from rtd3jax.envs.interface import describe
from rtd3jax.errors import UserError
from rtd3jax.protocols import EnvironmentLike

MOST_RICCATI_STEPS = 100_000
"""Iterations of the Riccati equation, at most."""


@struct.dataclass
class LinearPolicy:
    """``action - gain (observation - at)``, within the bounds; see `lqr_policy`."""

    gain: jax.Array
    """float32 [A, O]"""
    at: jax.Array
    """float32 [O], the observation of the equilibrium"""
    action: jax.Array
    """float32 [A], the action of the equilibrium"""
    low: jax.Array
    high: jax.Array
    action_shape: tuple[int, ...] = struct.field(pytree_node=False)
    observation_size: int = struct.field(pytree_node=False)

    def init(self, key: jax.Array | None = None) -> tuple:
        """The controller has no state."""
        return ()

    def step(self, state: tuple, observation: jax.Array) -> tuple[jax.Array, tuple]:
        """The action, within its bounds."""
        away = observation.astype(jnp.float32) - self.at
        wanted = self.action - jnp.sum(self.gain * away[None, :], axis=1)
        return jnp.clip(wanted, self.low, self.high).reshape(self.action_shape), state


def lqr_policy(
    env: EnvironmentLike,
    state: object,
    action: ArrayLike | Sequence[float] = 0.0,
    *,
    q: ArrayLike | Sequence[float] | None = None,
    r: ArrayLike | Sequence[float] | None = None,
    params: object = None,
) -> LinearPolicy:
    """The linear-quadratic regulator of ``env``, linearised about an equilibrium.

    ``jax.jacobian`` linearises the step and the observation of the undisturbed environment. The
    pseudo-inverse of the observation matrix estimates the state. The discrete Riccati equation is
    iterated until it converges.

    Args:
        env: an environment with ``step_env``, whose step JAX can differentiate. It may be
            disturbed; the regulator does not model the disturbance.
        state: the equilibrium: a state that ``env.reset`` returned, with replaced fields. For a
            disturbed environment, only the field ``env`` of the state is used. The S elements are
            those of the floating-point leaves, in order.
        action: the action of the equilibrium, a number or [A].
        q: cost of the state, [S] for a diagonal matrix, or [S, S]. By default, ``q`` and ``r`` are
            the curvature of the negative reward.
        r: cost of the action: a number, [A] or [A, A].
        params: the environment's parameters; its default parameters by default.

    Raises:
        UserError: for a state that is not an equilibrium, a cost that is not convex, a plant that
            is not stabilisable, or an observation that does not determine the state elements that
            the regulator uses.
    """
    params = parameters_of(env, params)
    own = describe(env, params)
    model = linearised(env, state, action, params, own)
    if (q is None) != (r is None):
        raise UserError("lqr_policy: pass both q and r, or neither to use the reward's curvature")
    if q is None or r is None:
        cost_x, cost_u, cross = model.curvature
        hint = "; the reward's curvature does not give such a cost here: pass q and r"
    else:
        cost_x, cost_u = _cost("q", q, len(model.names)), _cost("r", r, own.action_size)
        cross, hint = np.zeros((len(model.names), own.action_size)), ""
    whole = np.block([[cost_x, cross], [cross.T, cost_u]])
    scale = max(float(np.abs(whole).max()), 1e-12)
    if not np.isfinite(whole).all() or np.linalg.eigvalsh(whole).min() < -1e-6 * scale:
        raise UserError(f"lqr_policy needs a cost that is not negative{hint}")
    if np.linalg.eigvalsh(cost_u).min() <= 0:
        raise UserError(f"lqr_policy needs a positive cost of the action{hint}")
    gain = riccati_gain(model.a, model.b, cost_x, cost_u, cross)
    heeded = np.abs(gain).max(axis=0) > 1e-6 * max(np.abs(gain).max(), 1e-12)
    moved = np.abs(model.drift) > 1e-4
    if (heeded & moved).any():
        which = int(np.flatnonzero(heeded & moved)[0])
        raise UserError(
            f"lqr_policy needs an equilibrium: "
            f"{model.names[which]} changes by {model.drift[which]:.3g} in a step"
        )
    inverse = np.linalg.pinv(model.c, rcond=1e-6)
    seen_gain = gain @ inverse
    unknown = np.abs(seen_gain @ model.c - gain).max(axis=0)
    if unknown.max() > 1e-3 * max(np.abs(gain).max(), 1e-12):
        raise UserError(
            f"lqr_policy: the observation does not determine "
            f"{model.names[int(unknown.argmax())]}, which the regulator uses"
        )
    return LinearPolicy(
        gain=jnp.asarray(seen_gain, jnp.float32),
        at=jnp.asarray(model.at, jnp.float32),
        action=jnp.asarray(model.action, jnp.float32),
        low=jnp.asarray(own.action_low),
        high=jnp.asarray(own.action_high),
        action_shape=own.action_shape,
        observation_size=own.observation_size,
    )


def riccati_gain(
    a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray, cross: np.ndarray
) -> np.ndarray:
    """The gain K [A, S] of ``u = -K x`` that minimises a quadratic cost.

    The cost is the sum of ``x^T q x + 2 x^T cross u + u^T r u`` over all steps, with q [S, S],
    r [A, A] and cross [S, A]. The next state is ``a x + b u``, with a [S, S] and b [S, A]. Elements
    that are not controllable are allowed if they decay by themselves.

    Raises:
        UserError: when the iteration does not converge, because an element with a cost cannot be
            stabilised.
    """
    value = q.copy()
    for _ in range(MOST_RICCATI_STEPS):
        to_go = b.T @ value
        gain = np.linalg.solve(r + to_go @ b, to_go @ a + cross.T)
        new = q + a.T @ value @ a - (to_go @ a + cross.T).T @ gain
        new = 0.5 * (new + new.T)
        change, value = np.abs(new - value).max(), new
        if not np.isfinite(change) or np.abs(value).max() > 1e12:
            break
        if change <= 1e-10 * max(np.abs(value).max(), 1e-12):
            return gain
    raise UserError(
        "lqr_policy: the Riccati equation does not converge: an element with a cost cannot be "
        "stabilised"
    )


def _cost(name: str, value: ArrayLike | Sequence[float], size: int) -> np.ndarray:
    """A number, [size] or [size, size] as a symmetric float64 matrix."""
    array = np.asarray(value, np.float64)
    if array.shape == (size, size):
        return 0.5 * (array + array.T)
    if array.shape not in ((), (size,)):
        raise UserError(
            f"lqr_policy: {name} must have shape ({size},) or ({size}, {size}), not {array.shape}"
        )
    return np.diag(np.broadcast_to(array, (size,)))
