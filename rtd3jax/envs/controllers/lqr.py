"""Hand-designed controllers as policies: any function, PID and LQR.

A controller is evaluated and shown in tables and figures like a trained policy. Gains are arrays of
a pytree, so controllers with different gains share a compiled program. A function is part of its
program, so each function has its own program.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike

from rtd3jax.envs.disturbed import Disturbed, DisturbedState, seen_elements
from rtd3jax.envs.entry import parameters_of
from rtd3jax.envs.identity import strong
from rtd3jax.envs.interface import Interface, describe, environment_name, foreign_code
from rtd3jax.errors import UserError, first_line
from rtd3jax.protocols import EnvironmentLike

MOST_RICCATI_STEPS = 100_000
"""Iterations of the Riccati equation, at most."""

_UNTRACEABLE = (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError)


@struct.dataclass
class FunctionPolicy:
    """``function`` as a policy; see `function_policy`."""

    state: Any
    function: Callable[[Any, jax.Array], Any] = struct.field(pytree_node=False)

    def init(self, key: jax.Array | None = None) -> Any:
        """The state before the first step of an episode, the same for every episode."""
        return self.state

    def step(self, state: Any, observation: jax.Array) -> tuple[jax.Array, Any]:
        """The function's action [A] and next state."""
        name = getattr(self.function, "__name__", type(self.function).__name__)
        try:
            with foreign_code():
                returned = self.function(state, observation)
        except _UNTRACEABLE as error:
            raise UserError(
                f"{name} cannot be compiled: use jnp.where for branches, and jax.numpy "
                f"({first_line(error)})"
            ) from error
        if not isinstance(returned, tuple) or len(returned) != 2:
            raise UserError(f"{name} must return (action, state), not {type(returned).__name__}")
        action, after = returned
        shapes = [jax.tree.map(jnp.shape, tree) for tree in (state, after)]
        structures: list[Any] = [jax.tree.structure(tree) for tree in (state, after)]
        if structures[0] != structures[1] or shapes[0] != shapes[1]:
            raise UserError(
                f"{name} must return a state of the same shapes as its argument: {shapes[0]}, "
                f"not {shapes[1]}"
            )
        # A loop needs a state of fixed types, which a Python number in the sum must not change.
        after = jax.tree.map(lambda new, old: jnp.asarray(new).astype(old.dtype), after, state)
        return jnp.atleast_1d(jnp.asarray(action, jnp.float32)), after


def function_policy(
    function: Callable[[Any, jax.Array], tuple[Any, Any]], state: object = ()
) -> FunctionPolicy:
    """Any function ``(state, observation [O]) -> (action [A], state)`` as a policy.

    Args:
        function: a pure function in ``jax.numpy``. It is part of the compiled program: define it
            once, because each new function is compiled again.
        state: the state at the first step of an episode, a pytree of numbers and arrays.

    Raises:
        UserError: if ``function`` is not a function, or JAX does not accept ``state``.
    """
    if not callable(function):
        raise UserError(f"function_policy needs a function, not {function!r}")
    try:
        hash(function)
    except TypeError as error:
        raise UserError(f"function_policy needs a hashable function: {error}") from error
    try:
        return FunctionPolicy(strong(state), function)
    except TypeError as error:
        reason = first_line(error)
        raise UserError(f"the state of a function_policy holds arrays: {reason}") from error


class PIDState(NamedTuple):
    """The state of a PID controller.

    Attributes:
        time: int32 [], number of observations so far.
        integral: float32 [A], sum of the errors times the length of a step.
        error: float32 [A], the last error.
    """

    time: jax.Array
    integral: jax.Array
    error: jax.Array


@struct.dataclass
class PIDPolicy:
    """A PID controller for each element of the action; see `pid_policy`."""

    kp: jax.Array
    ki: jax.Array
    kd: jax.Array
    setpoint: jax.Array
    feedforward: jax.Array
    low: jax.Array
    high: jax.Array
    seconds: jax.Array
    elements: tuple[int, ...] = struct.field(pytree_node=False)
    ignored: int = struct.field(pytree_node=False)
    action_shape: tuple[int, ...] = struct.field(pytree_node=False)
    observation_size: int = struct.field(pytree_node=False)

    def init(self, key: jax.Array | None = None) -> PIDState:
        """The state before the first step of an episode: zero integral and error."""
        zeros = jnp.zeros_like(self.low)
        return PIDState(jnp.int32(0), zeros, zeros)

    def step(self, state: PIDState, observation: jax.Array) -> tuple[jax.Array, PIDState]:
        """The action, within its bounds, and the next state."""
        error = self.setpoint - observation[jnp.asarray(self.elements)].astype(jnp.float32)
        error = jnp.where(state.time < self.ignored, 0.0, error)
        integral = state.integral + error * self.seconds
        # The first error has no previous error, so its change is zero.
        change = jnp.where(state.time <= self.ignored, 0.0, error - state.error) / self.seconds
        wanted = self.feedforward + self.kp * error + self.ki * integral + self.kd * change
        action = jnp.clip(wanted, self.low, self.high)
        # Against wind-up: at a bound, the integral changes only if this leads away from the bound.
        winds_up = (wanted - action) * self.ki * error > 0
        integral = jnp.where(winds_up, state.integral, integral)
        after = PIDState(state.time + jnp.int32(1), integral, error)
        return action.reshape(self.action_shape), after


def pid_policy(
    env: EnvironmentLike,
    kp: ArrayLike | Sequence[float] = 0.0,
    ki: ArrayLike | Sequence[float] = 0.0,
    kd: ArrayLike | Sequence[float] = 0.0,
    *,
    setpoint: ArrayLike | Sequence[float] = 0.0,
    feedforward: ArrayLike | Sequence[float] = 0.0,
    elements: tuple[int, ...] | None = None,
    seconds: float = 1.0,
    ignored: int = 0,
    params: object = None,
) -> PIDPolicy:
    """A PID controller for each element of the action, with feed-forward and anti-windup.

    ``action = feedforward + kp e + ki sum(e) seconds + kd change(e) / seconds`` within the bounds
    of ``env``, with ``e = setpoint - observation[elements]``. All arguments except ``seconds`` and
    ``ignored`` are numbers or arrays [A].

    Args:
        env: the environment, which defines sizes and bounds; it may be disturbed.
        kp: gain of the error.
        ki: gain of the error's integral.
        kd: gain of the error's rate of change.
        setpoint: target values of the chosen elements of the observation.
        feedforward: the action at zero error.
        elements: index of the observation's element that each element of the action controls; the
            first A elements by default.
        seconds: length of a step in seconds; with 1, time is counted in steps.
        ignored: number of observations at the start of an episode that the controller ignores. If
            the plant starts at rest and responds to each command within one step, then the error
            of the first observation was not caused by any command.
        params: the environment's parameters; its default parameters by default.

    Raises:
        UserError: for gains that have a wrong shape or are not finite, and for indices that the
            observation does not have.
    """
    params = parameters_of(env, params)
    own = describe(env, params)
    size = own.action_size
    if elements is None and own.observation_size < size:
        raise UserError(
            f"pid_policy: {own.observation_size} observation elements for {size} actions: "
            "pass elements=(...), the index of the element that each action controls"
        )
    chosen = tuple(range(size)) if elements is None else tuple(elements)
    inside = all(isinstance(k, int | np.integer) and 0 <= k < own.observation_size for k in chosen)
    if len(chosen) != size or not inside:
        raise UserError(
            f"pid_policy: elements must be {size} integers from 0 to {own.observation_size - 1}, "
            f"not {elements!r}"
        )
    if not (np.ndim(seconds) == 0 and np.isfinite(seconds) and seconds > 0):
        raise UserError(f"pid_policy: seconds must be greater than 0, not {seconds!r}")
    if isinstance(ignored, bool) or not isinstance(ignored, int | np.integer) or ignored < 0:
        raise UserError(f"pid_policy: ignored must be an integer of at least 0, not {ignored!r}")
    values = {"kp": kp, "ki": ki, "kd": kd, "setpoint": setpoint, "feedforward": feedforward}
    arrays = {name: _vector("pid_policy", name, value, size) for name, value in values.items()}
    return PIDPolicy(
        **arrays,
        low=jnp.asarray(own.action_low),
        high=jnp.asarray(own.action_high),
        seconds=jnp.float32(seconds),
        elements=tuple(int(k) for k in chosen),
        ignored=int(ignored),
        action_shape=own.action_shape,
        observation_size=own.observation_size,
    )


@struct.dataclass
class LinearPolicy:
    """``action - gain (observation - at)``, within the bounds; see `lqr_policy`."""

    gain: jax.Array
    """float32 [A, O]"""
    at: jax.Array
    """float32 [O], the observation of the resting state"""
    action: jax.Array
    """float32 [A], the action of the resting state"""
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
    model = _linearised(env, state, action, params, own)
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
    """The gain K [A, S] of ``u = -K x`` that minimises the sum of ``x'qx + 2 x'cross u + u'ru``.

    ``x' = a x + b u`` with a [S, S] and b [S, A]. Elements that are not controllable are allowed if
    they decay by themselves.

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


class _Linear(NamedTuple):
    """A linearised step, float64: S elements of the state, A of the action, O observed elements."""

    a: np.ndarray  # [S, S]
    b: np.ndarray  # [S, A]
    c: np.ndarray  # [O, S]
    drift: np.ndarray  # [S], change of the state in one step
    at: np.ndarray  # [O]
    action: np.ndarray  # [A]
    curvature: tuple[np.ndarray, np.ndarray, np.ndarray]
    names: list[str]


def _linearised(
    env: EnvironmentLike,
    state: Any,
    action: ArrayLike | Sequence[float],
    params: Any,
    own: Interface,
) -> _Linear:
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
    centre = _vector("lqr_policy", "action", action, own.action_size)

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
            f"lqr_policy: {name} could not be linearised: {first_line(error)}"
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
    return _Linear(
        a=a,
        b=b,
        c=c[rows],
        drift=np.asarray(after - start, np.float64),
        at=np.asarray(at, np.float64)[rows],
        action=np.asarray(centre, np.float64),
        curvature=(xx, uu, xu),
        names=names,
    )


def _vector(where: str, name: str, value: ArrayLike | Sequence[float], size: int) -> jax.Array:
    """A number or [size], as float32 [size]; UserError for anything else."""
    try:
        array = np.asarray(value, np.float32)
    except (TypeError, ValueError) as error:
        raise UserError(f"{where}: {name} must be numbers, not {value!r}") from error
    if array.shape not in ((), (size,)) or not np.isfinite(array).all():
        raise UserError(f"{where}: {name} must be a finite number or {size} of them, not {value!r}")
    return jnp.broadcast_to(jnp.asarray(array), (size,))


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
