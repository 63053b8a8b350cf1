"""Linearisation of an environment's step by JAX."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike

from rtd3jax.envs.controllers.vectors import vector
from rtd3jax.envs.disturbed import Disturbed, DisturbedState, seen_elements
from rtd3jax.envs.identity import strong
from rtd3jax.envs.interface import Interface, environment_name, foreign_code
from rtd3jax.errors import UserError, short_reason
from rtd3jax.protocols import EnvironmentLike


class Linear(NamedTuple):
    """A linearised step, float64: S elements of the state, A of the action, O observed elements.

    ``curvature`` holds the second derivatives of half the negative reward: by the state [S, S], by
    the action [A, A], and by both [S, A]. ``names`` are the names of the S elements.
    """

    a: np.ndarray  # [S, S]
    b: np.ndarray  # [S, A]
    c: np.ndarray  # [O, S]
    drift: np.ndarray  # [S], change of the state in one step
    at: np.ndarray  # [O], the observation after the step
    action: np.ndarray  # [A]
    curvature: tuple[np.ndarray, np.ndarray, np.ndarray]
    names: list[str]


def linearised(
    env: EnvironmentLike,
    state: Any,
    action: ArrayLike | Sequence[float],
    params: Any,
    own: Interface,
) -> Linear:
    """The undisturbed step and the observation of ``env``, linearised at a state and an action.

    Raises:
        UserError: if JAX cannot differentiate the step there, if the action has no effect, or if it
            is not known which elements of the state ``env`` observes.
    """
    base: Any = env.base if isinstance(env, Disturbed) else env
    base_params = params.env if isinstance(env, Disturbed) else params
    state = state.env if isinstance(state, DisturbedState) else state
    name = environment_name(env)
    if not callable(getattr(base, "step_env", None)):
        raise UserError(f"lqr_policy: {name} has no step_env, as gymnax's Environment has")
    if getattr(base, "supports_transition_gradients", False):
        base = base.with_transition_gradients()  # without this call, gymnax's steps stop gradients
    leaves, structure = jax.tree.flatten(strong(state))
    steered = [k for k, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(state)]
    names = [
        paths[k].lstrip(".") + (f"[{i}]" if leaves[k].ndim else "")
        for k in steered
        for i in range(leaves[k].size)
    ]
    start, restore = ravel_pytree([leaves[k] for k in steered])
    centre = vector("lqr_policy", "action", action, own.action_size)

    def step(x: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        parts = list(leaves)
        for k, leaf in zip(steered, restore(x), strict=True):
            parts[k] = leaf
        with foreign_code():
            observation, after, reward, *_ = base.step_env(
                jax.random.key(0),
                jax.tree.unflatten(structure, parts),
                u.reshape(own.action_shape),
                base_params,
            )
        after = jax.tree.leaves(after)
        return ravel_pytree([after[k] for k in steered])[0], observation, reward.reshape(())

    def expand(x: jax.Array, u: jax.Array) -> tuple:
        curvature = jax.hessian(lambda *point: step(*point)[2], argnums=(0, 1))(x, u)
        return step(x, u), jax.jacobian(step, argnums=(0, 1))(x, u), curvature

    try:
        (after, at, _), by_point, hessian = jax.jit(expand)(start, centre)
        (a, b), (c_a, c_b), _ = by_point
    except UserError:
        raise
    except Exception as error:  # code of an environment may raise anything
        raise UserError(
            f"lqr_policy: {name} could not be linearised: {short_reason(error)}"
        ) from error
    a, b, c_a, c_b = (np.asarray(m, np.float64) for m in (a, b, c_a, c_b))
    if not np.abs(b).max() > 0:
        raise UserError(
            f"lqr_policy: the action has no effect on {name} there, or its step stops gradients"
        )
    # The observation belongs to the state after the step: the Jacobians are c a and c b. They
    # determine c for all states that a step can reach.
    c = np.hstack([c_a, c_b]) @ np.linalg.pinv(np.hstack([a, b]), rcond=1e-6)
    rows = seen_elements(env, params, c.shape[0])
    if len(rows) != own.observation_size:
        raise UserError(f"lqr_policy: it is not known which elements of the state {name} observes")
    (xx, xu), (_, uu) = ([-0.5 * np.asarray(part, np.float64) for part in line] for line in hessian)
    return Linear(
        a=a,
        b=b,
        c=c[rows],
        drift=np.asarray(after - start, np.float64),
        at=np.asarray(at, np.float64)[rows],
        action=np.asarray(centre, np.float64),
        curvature=(xx, uu, xu),
        names=names,
    )
