"""A simulator on the host behind gymnax's interface; the compiled program calls it.

The state contains the simulator's handle, and the seed and actions of its episode, which can replay
it. So a lane that is resumed continues at the same step, if the simulator is deterministic.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnax.environments import environment, spaces
from jax.typing import ArrayLike

from rtd3jax.envs.compat.host_call import host_call
from rtd3jax.envs.compat.resets import step_with_reset
from rtd3jax.envs.compat.simulator import SEED_DIGEST, Fault, Fleet, faults_of, say
from rtd3jax.envs.compat.simulator_state import SimulatorState
from rtd3jax.envs.compat.surface import Surface
from rtd3jax.envs.entry import DEFAULT_STEP_LIMIT
from rtd3jax.envs.identity import ValueIdentity
from rtd3jax.errors import UserError

_Whole = np.ndarray | jax.Array
"""An integer []."""


class SimulatorParams(struct.PyTreeNode):
    """The parameters that can be set from outside; all others belong to the simulator."""

    max_steps_in_episode: int = DEFAULT_STEP_LIMIT


class FromGymnasium(ValueIdentity, environment.Environment):
    """A Gymnasium environment behind gymnax's interface; made by `from_gymnasium`.

    ``words`` states in words what makes the environment, and its keywords, as files store them.
    """

    def __init__(
        self, key: tuple, words: tuple[str, str], title: str, fleet: Fleet, surface: Surface
    ) -> None:
        super().__init__()
        self._key = key
        self.words = words
        self._title = title
        self.fleet = fleet
        self._surface = surface

    def identity(self) -> tuple:
        """The arguments with which it was made."""
        return self._key

    def _identity(self) -> tuple:
        # A key cannot tell whether code was edited. In this process, the simulators stand for it.
        return (*super()._identity(), self.fleet)

    @property
    def name(self) -> str:
        """The id, or the name of the function that makes the environment."""
        return self._title

    @property
    def element_names(self) -> tuple[str, ...]:
        """A name for each observed element."""
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
        """A Box with the environment's own bounds."""
        box = self._surface.actions
        low, high = (jnp.asarray(bound, jnp.float32) for bound in (box.low, box.high))
        return spaces.Box(low, high, box.shape, jnp.float32)

    def observation_space(self, params: SimulatorParams | None = None) -> spaces.Box:
        """A Box without bounds."""
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
        """Begin an episode in the state's simulator if ``where`` (bool []) is true."""
        seed = jax.random.bits(key, (), jnp.uint32) >> jnp.uint32(1)
        shapes = ((), jnp.int32), ((len(self._surface.keep),), jnp.float32), ((2,), jnp.uint32)
        handle, observation, digest = host_call(
            self._reset, shapes, jnp.any, where, state.handle, seed, most=self.fleet.most
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
        """One step of the simulator, without automatic reset."""
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
        # XLA may compute an action twice, with different rounding. So the host returns the action
        # that it received, and the state stores it.
        handle, observation, reward, terminated, truncated, digest, action = host_call(
            self._step, shapes, None, *place, action, state.actions, most=self.fleet.most
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
        """One step with automatic reset; the simulator is reset only at the end of an episode."""
        params = self.default_params if params is None else params
        return step_with_reset(self, key, state, action, params)

    def is_terminated(self, state: SimulatorState, params: SimulatorParams) -> jax.Array:
        """Whether the episode ended by itself."""
        return state.terminated

    def is_truncated(self, state: SimulatorState, params: SimulatorParams) -> jax.Array:
        """Whether a time limit was reached, this one or the environment's own."""
        return state.truncated | (state.time >= params.max_steps_in_episode)

    def _reset(self, where: np.ndarray, handle: np.ndarray, seed: np.ndarray) -> tuple:
        """The part of `reset_where` that runs on the host."""
        observation = np.zeros(len(self._surface.keep), np.float32)
        if not where:
            return handle, observation, SEED_DIGEST
        try:
            found, flat, digest = self.fleet.reset(int(handle), int(seed))
        except Fault as fault:
            _report(self.name, fault)
            return fault.args[1], np.full_like(observation, np.nan), SEED_DIGEST
        return found, self._surface.seen(flat), digest

    def _step(
        self,
        handle: np.ndarray,
        seed: np.ndarray,
        time: np.ndarray,
        digest: np.ndarray,
        action: np.ndarray,
        past: np.ndarray,
    ) -> tuple:
        """The part of `step_env` that runs on the host."""
        place = _place(seed, time, digest)
        try:
            found, simulator = self.fleet.at(int(handle), place, self._commands(past))
            if simulator is None:
                raise Fault(self.fleet.record_fault(found, _other(place[1])), found)
            with faults_of(found):
                if place[1] >= self._surface.limit:
                    raise simulator.failed(self._too_long("its episode goes on"))
                flat, reward, terminated, truncated = simulator.step(self._surface.command(action))
        except Fault as fault:
            _report(self.name, fault)
            nothing = np.full(len(self._surface.keep), np.nan, np.float32)
            return fault.args[1], nothing, math.nan, False, False, SEED_DIGEST, action
        assert simulator.place is not None
        answer = self._surface.seen(flat), reward, terminated, truncated, simulator.place[2]
        return found, *answer, action

    def check_params(self, params: SimulatorParams) -> None:
        """Raise UserError if the time limit exceeds the number of actions that the state holds."""
        limit = params.max_steps_in_episode
        if isinstance(limit, jax.core.Tracer):
            return  # the simulator itself refuses
        if int(limit) > self._surface.limit:
            raise UserError(f"{self.name}: {self._too_long(f'max_steps_in_episode={limit} is')}")

    def _too_long(self, what: str) -> str:
        return (
            f"{what} beyond the {self._surface.limit:,} steps with which it was made; give "
            "rtd.from_gymnasium a larger max_steps_in_episode"
        )

    def _commands(self, rows: np.ndarray) -> Callable[[int], list[np.ndarray]]:
        return lambda count: [self._surface.command(row) for row in rows[:count]]

    def restored(self, state: SimulatorState) -> SimulatorState | None:
        """The state of another process, with simulators of this process at the same positions.

        Each simulator replays its episode. The result is None if a simulator reaches another
        position, which means that it is not deterministic. If a simulator fails, the next step
        reports its fault.
        """
        if state.handle.ndim:
            rows = range(state.handle.shape[0])
            parts = [self.restored(jax.tree.map(lambda leaf, k=k: leaf[k], state)) for k in rows]
            if any(part is None for part in parts):
                for part in parts:
                    if part is not None:  # no state will name this simulator
                        self.fleet.release(int(part.handle))
                return None
            return jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)
        place = _place(state.seed, state.time, state.digest)
        past = self._commands(np.asarray(state.actions))
        try:
            # A handle is valid in one process. Here, the same number may belong to another lane.
            found, simulator = self.fleet.at(-1, place, past)
        except Fault as fault:
            return state.replace(handle=jnp.int32(fault.args[1]))
        if simulator is None:
            self.fleet.release(found)
            say(f"{self.name}: {_other(place[1])}; a fresh one begins")
            return None
        return state.replace(handle=jnp.int32(found))


def _place(seed: _Whole, time: _Whole, digest: ArrayLike) -> tuple[int, int, tuple[int, int]]:
    """The position of a simulator for `Fleet.at`: seed, time and digest."""
    first, second = np.asarray(digest).tolist()
    return int(seed), int(time), (first, second)


def _other(steps: int) -> str:
    return f"it is not deterministic: its episode, replayed for {steps} steps, was another"


_told: set[tuple[str, int]] = set()


def _report(name: str, fault: Fault) -> None:
    """Report a fault once for each simulator."""
    told = name, int(fault.args[1])
    if told not in _told:
        _told.add(told)
        say(f"{name}: {fault.args[0]}")
