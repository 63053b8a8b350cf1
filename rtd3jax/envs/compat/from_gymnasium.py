"""Any Gymnasium environment for the trainer: the simulator runs on the host, called by the program.

The state names the simulator and has what replays its episode, so that it is complete: a lane that
is resumed goes on where it was, if the simulator is deterministic.
"""

import dataclasses
import hashlib
import math
import pickle
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnax.environments import environment, spaces
from jax.experimental import io_callback
from jax.typing import ArrayLike

from rtd3jax.envs.compat.simulator import Fault, Fleet, faults_of, say
from rtd3jax.envs.identity import ValueIdentity
from rtd3jax.envs.interface import DEFAULT_STEP_LIMIT
from rtd3jax.errors import UserError, first_line, nearest

PREFIX = "gymnasium:"
"""Before an id of Gymnasium's where an environment is named."""

STEP_SECONDS = 60.0
"""The longest that a call of a simulator may take by default."""


class ResettableWhere(Protocol):
    """What `step_with_reset` needs."""

    step_env: Callable[..., tuple]
    is_truncated: Callable[..., jax.Array]
    reset_where: Callable[..., tuple]


class SimulatorParams(struct.PyTreeNode):
    """What can be set from outside; everything else is the environment's own."""

    max_steps_in_episode: int = DEFAULT_STEP_LIMIT


class SimulatorState(struct.PyTreeNode):
    """One episode, and all that replays it."""

    time: jax.Array
    """int32 []: steps taken"""
    handle: jax.Array
    """int32 []: the simulator, in the process that made it"""
    seed: jax.Array
    """uint32 []: with which the episode began"""
    digest: jax.Array
    """uint32 [2]: of all that the simulator answered in this episode, to the bit"""
    actions: jax.Array
    """float32 [T, A]: those of this episode"""
    terminated: jax.Array
    """bool []"""
    truncated: jax.Array
    """bool []: by the environment itself"""


class FromGymnasium(ValueIdentity, environment.Environment):
    """A Gymnasium environment behind gymnax's interface; made by `from_gymnasium`."""

    def __init__(self, key: tuple, title: str, fleet: Fleet, surface: "_Surface") -> None:
        super().__init__()
        self._key = key
        self._title = title
        self.fleet = fleet
        self._surface = surface

    def identity(self) -> tuple:
        """What it was made of."""
        return self._key

    @property
    def name(self) -> str:
        """The id, or the name of the environment's class."""
        return self._title

    @property
    def element_names(self) -> tuple[str, ...]:
        """A name for each element that is seen."""
        names = self._surface.names
        return tuple(names[index] for index in self._surface.keep)

    @property
    def default_params(self) -> SimulatorParams:
        """The time limit."""
        return SimulatorParams(self._surface.limit)

    @property
    def num_actions(self) -> int:
        """Elements of an action."""
        return math.prod(self._surface.actions.shape)

    def action_space(self, params: SimulatorParams | None = None) -> spaces.Box:
        """The environment's own bounds, element by element."""
        box = self._surface.actions
        low, high = (jnp.asarray(bound, jnp.float32) for bound in (box.low, box.high))
        return spaces.Box(low, high, box.shape, jnp.float32)

    def observation_space(self, params: SimulatorParams | None = None) -> spaces.Box:
        """Unbounded."""
        return spaces.Box(-jnp.inf, jnp.inf, (len(self._surface.keep),), jnp.float32)

    def reset_env(
        self, key: jax.Array, params: SimulatorParams
    ) -> tuple[jax.Array, SimulatorState]:
        """Begin an episode in a simulator of its own; the observation is float32 [O]."""
        blank = SimulatorState(
            time=jnp.int32(0),
            handle=jnp.int32(-1),
            seed=jnp.uint32(0),
            digest=jnp.zeros((2,), jnp.uint32),
            actions=jnp.zeros((self._surface.limit, self.num_actions), jnp.float32),
            terminated=jnp.array(False),
            truncated=jnp.array(False),
        )
        return self.reset_where(jnp.array(True), key, blank, params)

    def reset_where(
        self, where: jax.Array, key: jax.Array, state: SimulatorState, params: SimulatorParams
    ) -> tuple[jax.Array, SimulatorState]:
        """Begin an episode in the state's simulator where ``where`` (bool []) is true."""
        seed = jax.random.bits(key, (), jnp.uint32) >> jnp.uint32(1)
        shapes = ((), jnp.int32), ((len(self._surface.keep),), jnp.float32), ((2,), jnp.uint32)
        handle, observation, digest = _called(
            self._reset, shapes, jnp.any, where, state.handle, seed
        )
        return observation, state.replace(
            time=jnp.int32(0),
            handle=jnp.where(where, handle, state.handle),
            seed=seed,
            digest=digest,
            terminated=jnp.array(False),
            truncated=jnp.array(False),
        )

    def step_env(
        self,
        key: jax.Array,
        state: SimulatorState,
        action: ArrayLike,
        params: SimulatorParams,
    ) -> tuple[jax.Array, SimulatorState, jax.Array, jax.Array, dict[Any, Any]]:
        """One step of the simulator; without an automatic reset."""
        action = jnp.asarray(action, jnp.float32).reshape(-1)
        size = len(self._surface.keep)
        shapes = (
            ((), jnp.int32),
            ((size,), jnp.float32),
            ((), jnp.float32),
            ((), jnp.bool_),
            ((), jnp.bool_),
            ((2,), jnp.uint32),
            (action.shape, jnp.float32),
        )
        place = state.handle, state.seed, state.time, state.digest
        # XLA may compute an action twice, by two roundings: what the host got is what is kept.
        handle, observation, reward, terminated, truncated, digest, action = _called(
            self._step, shapes, None, *place, action, state.actions
        )
        actions = jax.lax.dynamic_update_slice(
            state.actions, action[None], (state.time, jnp.int32(0))
        )
        evolved = SimulatorState(
            time=state.time + 1,
            handle=handle,
            seed=state.seed,
            digest=digest,
            actions=actions,
            terminated=terminated,
            truncated=truncated,
        )
        return observation, evolved, reward, terminated, {}

    def step(
        self, key: jax.Array, state: object, action: ArrayLike, params: object = None
    ) -> tuple:
        """One step; the next episode begins where this one ended, and only there."""
        params = self.default_params if params is None else params
        return step_with_reset(self, key, state, action, params)

    def is_terminated(self, state: SimulatorState, params: SimulatorParams) -> jax.Array:
        """Whether the episode ended by itself."""
        return state.terminated

    def is_truncated(self, state: SimulatorState, params: SimulatorParams) -> jax.Array:
        """Whether a time limit was reached, this one or the environment's own."""
        return state.truncated | (state.time >= params.max_steps_in_episode)

    def _reset(self, where: np.ndarray, handle: np.ndarray, seed: np.ndarray) -> tuple:
        """On the host."""
        observation = np.zeros(len(self._surface.keep), np.float32)
        if not where:
            return handle, observation, np.zeros(2, np.uint32)
        try:
            found, flat, digest = self.fleet.reset(int(handle), int(seed))
        except Fault as fault:
            _report(self.name, fault)
            lost = np.int32(fault.args[1])
            return lost, np.full_like(observation, np.nan), np.zeros(2, np.uint32)
        return np.int32(found), self._seen(flat), np.asarray(digest, np.uint32)

    def _step(
        self,
        handle: np.ndarray,
        seed: np.ndarray,
        time: np.ndarray,
        digest: np.ndarray,
        action: np.ndarray,
        past: np.ndarray,
    ) -> tuple:
        """On the host."""
        place = _place(seed, time, digest)
        try:
            found, simulator = self.fleet.at(int(handle), place, self._commands(past))
            if simulator is None:
                raise Fault(_other(self.name, place[1]), found)
            with faults_of(found):
                flat, reward, terminated, truncated = simulator.step(self._command(action))
        except Fault as fault:
            _report(self.name, fault)
            number, lost = np.int32(fault.args[1]), np.float32(np.nan)
            nothing = np.full(len(self._surface.keep), np.nan, np.float32)
            return number, nothing, lost, np.False_, np.False_, np.zeros(2, np.uint32), action
        assert simulator.place is not None
        digest = np.asarray(simulator.place[2], np.uint32)
        flags = np.bool_(terminated), np.bool_(truncated)
        return np.int32(found), self._seen(flat), np.float32(reward), *flags, digest, action

    def _command(self, action: np.ndarray) -> np.ndarray:
        box = self._surface.actions
        wide = np.asarray(action, np.float64).reshape(box.shape)
        return np.clip(wide, box.low, box.high).astype(box.dtype)

    def _commands(self, rows: np.ndarray) -> Callable[[int], list[np.ndarray]]:
        return lambda count: [self._command(row) for row in rows[:count]]

    def _seen(self, flat: np.ndarray) -> np.ndarray:
        return flat[self._surface.indices].astype(np.float32)

    def restored(self, state: SimulatorState) -> SimulatorState | None:
        """A state from another process, with simulators of this one at its places, to the bit.

        None where one came to another place, because it is not deterministic. Of a simulator that
        fails, the next step says so.
        """
        if state.handle.ndim:
            rows = range(state.handle.shape[0])
            parts = [self.restored(jax.tree.map(lambda leaf, k=k: leaf[k], state)) for k in rows]
            if any(part is None for part in parts):
                return None
            return jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)
        place = _place(state.seed, state.time, state.digest)
        past = self._commands(np.asarray(state.actions))
        try:
            # Handles are a process's own: what this one calls so is another lane's.
            found, simulator = self.fleet.at(-1, place, past)
        except Fault as fault:
            return state.replace(handle=jnp.int32(fault.args[1]))
        if simulator is None:
            self.fleet.release(found)
            say(_other(self.name, place[1]))
            return None
        return state.replace(handle=jnp.int32(found))


def _place(seed: ArrayLike, time: ArrayLike, digest: ArrayLike) -> tuple[int, int, tuple[int, int]]:
    """Where a simulator is to be, as `Fleet.at` has it."""
    first, second = np.asarray(digest).tolist()
    return int(np.asarray(seed)), int(np.asarray(time)), (first, second)


def _other(name: str, steps: int) -> str:
    return (
        f"{name} is not deterministic: its episode, replayed for {steps} steps, was another; "
        "a fresh one begins"
    )


_told: set[tuple[str, int]] = set()


def _report(name: str, fault: Fault) -> None:
    """Say a fault once for each simulator."""
    told = name, int(fault.args[1])
    if told not in _told:
        _told.add(told)
        say(f"{name}: {fault.args[0]}")


def step_with_reset(
    env: ResettableWhere, key: jax.Array, state: object, action: ArrayLike, params: object
) -> tuple:
    """gymnax's step for an environment with ``reset_where``, which resets only at an end."""
    key_step, key_reset = jax.random.split(key)
    final, evolved, reward, terminated, info = env.step_env(key_step, state, action, params)
    truncated = env.is_truncated(evolved, params)
    done = terminated | truncated
    first, fresh = env.reset_where(done, key_reset, evolved, params)

    def either(new: jax.Array, old: jax.Array) -> jax.Array:
        return new if new is old else jnp.where(done, new, old)

    seen, following = either(first, final), jax.tree.map(either, fresh, evolved)
    info = {**info, "terminated": terminated, "truncated": truncated, "final_observation": final}
    return seen, following, reward, terminated, truncated, info


def _called(
    host: Callable[..., tuple],
    shapes: tuple[tuple[tuple[int, ...], Any], ...],
    due: Callable[[jax.Array], jax.Array] | None,
    *arguments: jax.Array,
) -> tuple[jax.Array, ...]:
    """The host's answers; side by side, one call asks for all of them, in their order.

    With ``due``, of the first argument, the host is called where it is true; else zeros.
    """
    arguments = tuple(map(jnp.asarray, arguments))
    ranks = [argument.ndim for argument in arguments]
    dtypes = [argument.dtype for argument in arguments]

    def on_host(*given: jax.Array) -> tuple[np.ndarray, ...]:
        arrays = [np.asarray(array) for array in given]
        lead = arrays[0].shape[: arrays[0].ndim - ranks[0]]
        if not lead:
            return host(*arrays)
        flat = [a.reshape(-1, *a.shape[len(lead) :]) for a in arrays]
        answers = [host(*row) for row in zip(*flat, strict=True)]
        columns = zip(*answers, strict=True)
        return tuple(
            np.stack(column).reshape(*lead, *shape).astype(dtype)
            for column, (shape, dtype) in zip(columns, shapes, strict=True)
        )

    @jax.custom_batching.custom_vmap
    def call(*given: jax.Array) -> tuple[jax.Array, ...]:
        lead = given[0].shape[: given[0].ndim - ranks[0]]
        results = tuple(jax.ShapeDtypeStruct((*lead, *shape), dtype) for shape, dtype in shapes)

        def ask(*given: jax.Array) -> tuple[jax.Array, ...]:
            return tuple(io_callback(on_host, results, *given))

        if due is None:
            return ask(*given)

        def skip(*given: jax.Array) -> tuple[jax.Array, ...]:
            return tuple(jnp.zeros(result.shape, result.dtype) for result in results)

        return jax.lax.cond(due(given[0]), ask, skip, *given)

    @call.def_vmap
    def _side_by_side(size: int, batched: list[bool], *given: jax.Array) -> tuple:
        wide = []
        for array, dtype, is_batched in zip(given, dtypes, batched, strict=True):
            known = jnp.asarray(array, dtype)  # a constant may come as a Python number
            wide.append(known if is_batched else jnp.broadcast_to(known, (size, *known.shape)))
        return call(*wide), tuple(True for _ in shapes)

    return call(*arguments)


def without_handles(tree: object) -> Any:
    """A result with the numbers of its simulators, which every call gives anew, set to zero."""

    def plain(part: object) -> object:
        return part.replace(handle=0 * part.handle) if isinstance(part, SimulatorState) else part

    return jax.tree.map(plain, tree, is_leaf=lambda part: isinstance(part, SimulatorState))


def innermost(env: object) -> object:
    """The environment below all disturbances."""
    while hasattr(env, "base"):
        env = env.base
    return env


def is_simulated(env: object) -> bool:
    """Whether a simulator on the host plays the environment, disturbed or not."""
    return isinstance(innermost(env), FromGymnasium)


def release(env: object, env_state: object) -> None:
    """Within a program: the simulators of a state, or of several, are free for other episodes."""
    states = jax.tree.leaves(env_state, is_leaf=lambda part: isinstance(part, SimulatorState))
    base = innermost(env)
    for state in states:
        if isinstance(state, SimulatorState) and isinstance(base, FromGymnasium):
            fleet = base.fleet

            def free(handles: jax.Array, fleet: Fleet = fleet) -> None:
                for handle in np.asarray(handles).reshape(-1):
                    fleet.release(int(handle))

            io_callback(free, None, state.handle)


def simulator_state(env_state: object) -> SimulatorState | None:
    """The part of an environment's state that is a simulator's; None where there is none."""
    parts = jax.tree.leaves(env_state, is_leaf=lambda part: isinstance(part, SimulatorState))
    return next((part for part in parts if isinstance(part, SimulatorState)), None)


def with_simulator(env_state: object, simulator: SimulatorState) -> Any:
    """An environment's state with another state of its simulator."""
    return jax.tree.map(
        lambda part: simulator if isinstance(part, SimulatorState) else part,
        env_state,
        is_leaf=lambda part: isinstance(part, SimulatorState),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _Surface:
    """What the outside of an environment is like."""

    actions: gymnasium.spaces.Box
    names: tuple[str, ...]
    keep: tuple[int, ...]
    limit: int

    @property
    def indices(self) -> np.ndarray:
        """As an index."""
        return np.asarray(self.keep)


def from_gymnasium(
    env: str | Callable[[], gymnasium.Env],
    *,
    keep: Iterable[int] | slice | None = None,
    max_steps_in_episode: int | None = None,
    step_seconds: float = STEP_SECONDS,
    **kwargs: Any,
) -> FromGymnasium:
    """A Gymnasium environment for `train`, `disturb`, `evaluate` and all else.

    ``rtd.from_gymnasium("HalfCheetah-v5", keep=slice(8))`` hides the velocities. The simulator runs
    on the host, an instance for each lane and each episode of an evaluation. Every episode begins
    with ``reset(seed=...)``, its seed drawn from the lane's.

    Args:
        env: an id, or a function without arguments that makes an environment.
        keep: indices, or a slice, of the elements that are seen; all by default. Dict and Tuple
            observations are concatenated first; ``element_names`` names the elements.
        max_steps_in_episode: the time limit, a truncation; the environment's own by default, else
            10,000.
        step_seconds: the longest that a call may take before its lane is lost; 60 by default.
        **kwargs: to ``gymnasium.make`` or the function.

    Raises:
        UserError: for what cannot be made or learned from, with the remedy.
    """
    title = env if isinstance(env, str) else getattr(env, "__name__", type(env).__name__)
    if isinstance(env, gymnasium.Env | gymnasium.vector.VectorEnv):
        raise UserError(
            f"{type(env).__name__} is one environment, and each lane needs its own: give its id, "
            "or a function that makes it"
        )
    if not isinstance(env, str) and not callable(env):
        raise UserError(f"{env!r} is neither an id of Gymnasium nor a function that makes one")
    if isinstance(step_seconds, bool) or not 0 < step_seconds < math.inf:
        raise UserError(f"step_seconds={step_seconds!r} must be a number of seconds above 0")

    def make() -> gymnasium.Env:
        if not isinstance(env, str):
            return env(**kwargs)
        limit = {} if max_steps_in_episode is None else {"max_episode_steps": max_steps_in_episode}
        return gymnasium.make(env, **{**limit, **kwargs})

    example = _example(make, env, title)
    try:
        surface, read = _surface(example, title, keep, max_steps_in_episode)
    finally:
        _close(example)
    key = (env, _named(kwargs), surface.keep, surface.limit, float(step_seconds))
    if key not in _known:
        _known[key] = Fleet(make, read, float(step_seconds))
    return FromGymnasium(key, title, _known[key], surface)


_known: dict[tuple, Fleet] = {}


def _named(kwargs: dict[str, Any]) -> str:
    """Keywords in a form that differs where they do: arrays print a part of themselves alone."""
    try:
        code = pickle.dumps(sorted(kwargs.items()))
    except Exception:  # what cannot be pickled is the same as itself alone
        return repr([(name, id(value)) for name, value in sorted(kwargs.items())])
    return hashlib.sha256(code).hexdigest()[:16] if kwargs else ""


def simulated_identity(env: object) -> str:
    """What a simulator's environment was made of, as checkpoints have it."""
    base = innermost(env)
    assert isinstance(base, FromGymnasium)
    made, kwargs, keep, limit, _ = base.identity()
    name = made if isinstance(made, str) else base.name
    return f"{name} keep={keep} limit={limit} {kwargs}".strip()


def _example(make: Callable[[], Any], env: object, title: str) -> gymnasium.Env:
    try:
        example = make()
    except gymnasium.error.DependencyNotInstalled as error:
        raise UserError(
            f"{title} needs a package that is missing ({first_line(error)}): "
            "pip install 'rtd3jax[mujoco]' for those of MuJoCo"
        ) from error
    except gymnasium.error.UnregisteredEnv as error:
        raise UserError(
            f"Gymnasium has no environment {title!r}{nearest(title, gymnasium.registry)}; "
            "import the module that registers it (--import in a sweep)"
        ) from error
    except Exception as error:
        reason = f"{type(error).__name__}: {first_line(error)}"
        raise UserError(f"{title} cannot be made: {reason}") from error
    if isinstance(example, gymnasium.vector.VectorEnv):
        _close(example)
        raise UserError(
            f"{title} makes a vector environment; give a function that makes one environment: "
            "every lane makes its own"
        )
    for method in ("reset", "step", "action_space", "observation_space"):
        if not hasattr(example, method):
            raise UserError(
                f"{title} made a {type(example).__name__}, which has no {method}: it is not a "
                "gymnasium.Env"
            )
    return example


def _close(example: gymnasium.Env | gymnasium.vector.VectorEnv) -> None:
    try:
        example.close()
    except Exception as error:
        say(f"close of {type(example).__name__} raised {type(error).__name__}: {first_line(error)}")


def _surface(
    example: gymnasium.Env, title: str, keep: Iterable[int] | slice | None, limit: int | None
) -> tuple[_Surface, Callable[[Any], np.ndarray]]:
    actions, seen = example.action_space, example.observation_space
    if not isinstance(actions, gymnasium.spaces.Box):
        raise UserError(
            f"{title} has the actions {actions}; rtd3jax learns continuous ones: choose an "
            "environment whose action space is a bounded Box"
        )
    if not (np.isfinite(actions.low).all() and np.isfinite(actions.high).all()):
        raise UserError(
            f"{title} has unbounded actions: give them finite bounds, for example by "
            "gymnasium.wrappers.RescaleAction in a function that makes it"
        )
    names = tuple(_names(seen, "", title))
    every = range(len(names))
    indices = (
        tuple(every)
        if keep is None
        else tuple(every[keep])
        if isinstance(keep, slice)
        else tuple(int(index) for index in keep)
    )
    if not indices or len(set(indices)) < len(indices) or min(indices) < 0:
        raise UserError(f"keep={keep!r} must name distinct elements, not negative, at least one")
    if max(indices) >= len(names):
        raise UserError(f"keep={max(indices)} is not in {title}'s observation of {len(names)}")
    if limit is None:
        spec = getattr(example, "spec", None)
        limit = getattr(spec, "max_episode_steps", None) or DEFAULT_STEP_LIMIT
    if isinstance(limit, bool) or limit != int(limit) or limit < 1:
        raise UserError(f"max_steps_in_episode={limit!r} must be an integer of at least 1")
    size = len(names)

    def read(observation: object) -> np.ndarray:
        flat = _flat(seen, observation)
        if flat.shape != (size,):
            raise ValueError(f"it has {flat.size} elements instead of {size}")
        return flat

    return _Surface(actions, names, indices, int(limit)), read


def _names(space: gymnasium.Space, name: str, title: str) -> Iterable[str]:
    if isinstance(space, gymnasium.spaces.Dict):
        for key, part in space.items():
            yield from _names(part, f"{name}.{key}" if name else str(key), title)
    elif isinstance(space, gymnasium.spaces.Tuple):
        for index, part in enumerate(space):
            yield from _names(part, f"{name}.{index}" if name else str(index), title)
    elif isinstance(space, gymnasium.spaces.Box):
        if space.dtype == np.uint8 or len(space.shape) > 2:
            raise UserError(
                f"{title} has images {space.shape} as observations; rtd3jax learns from vectors: "
                "put what they show into one, in a wrapper"
            )
        yield from (f"{name}[{k}]" if name else str(k) for k in range(math.prod(space.shape)))
    else:
        raise UserError(
            f"{title} has observations {space}; rtd3jax learns from a Box, or a Dict or Tuple of "
            "them: convert it in a wrapper (gymnasium.wrappers.TransformObservation)"
        )


def _flat(space: gymnasium.Space, observation: object) -> np.ndarray:
    parts: Any = observation
    if isinstance(space, gymnasium.spaces.Dict):
        return np.concatenate([_flat(part, parts[key]) for key, part in space.items()])
    if isinstance(space, gymnasium.spaces.Tuple):
        pairs = zip(space, parts, strict=True)
        return np.concatenate([_flat(part, value) for part, value in pairs])
    array = np.asarray(observation, np.float64)
    if array.shape != space.shape:
        raise ValueError(f"it has the shape {array.shape} instead of {space.shape}")
    return array.reshape(-1)
