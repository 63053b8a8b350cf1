"""An environment whose observation, action or reward a process disturbs (paper, Section 5.2)."""

import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces
from jax.typing import ArrayLike

from rtd3jax.envs.compat.resets import step_with_reset
from rtd3jax.envs.compat.simulated import is_simulated
from rtd3jax.envs.entry import DEFAULT_STEP_LIMIT, parameters_of, step_limit
from rtd3jax.envs.identity import ValueIdentity, strong
from rtd3jax.envs.interface import describe, environment_name, foreign_code
from rtd3jax.envs.processes.disturbances import Hidden
from rtd3jax.envs.processes.mixture import Mixture
from rtd3jax.envs.processes.process import Chain, NoDisturbance, Process
from rtd3jax.errors import UserError, nearest
from rtd3jax.protocols import ComposableEnvironment, EnvironmentLike

REWARDS_FROM = ("state", "observation")
CHANNELS = ("observation", "action", "reward")
"""The channels that a process can disturb: each is a field of ``DisturbedParams``."""

# Numbers that are folded into the key of the observation's process, for the keys of the action's
# and the reward's processes. Processes themselves fold small numbers into their keys.
_ACTION_STREAM, _REWARD_STREAM = 0x61637400, 0x72657700


class DisturbedParams(struct.PyTreeNode):
    """Parameters of the wrapped environment, and the processes that disturb it."""

    env: Any
    observation: Process = NoDisturbance()
    """process of the observation [O]"""
    action: Process = NoDisturbance()
    """process of the flat action [A], between the agent and the environment"""
    reward: Process = NoDisturbance()
    """process of the reward, as a signal [1]"""

    @property
    def max_steps_in_episode(self) -> int | jax.Array:
        """The time limit of an episode in steps, a parameter of the wrapped environment."""
        return self.env.max_steps_in_episode

    @property
    def process(self) -> Process:
        """The observation's process, under the name that earlier versions used."""
        return self.observation


class DisturbedState(struct.PyTreeNode):
    """The state of one episode."""

    time: jax.Array
    """int32 []: steps taken"""
    env: Any
    """state of the wrapped environment"""
    process: Any
    """state of the observation's process, drawn at the start of each episode"""
    action: ArrayLike
    """state of the action's process, drawn at the start of each episode"""
    reward: Any
    """state of the reward's process, drawn at the start of each episode"""
    observation: jax.Array
    """float32 [O]: the last observation that the agent received"""
    true_observation: jax.Array
    """float32 [S]: the same observation, undisturbed"""


class Disturbed(ValueIdentity, environment.Environment):
    """``base`` with observation, action and reward passed through the processes of ``params``.

    The observation's process receives the first observation of an episode and the observation after
    each step, including the final one. After an automatic reset, the process is drawn again and
    receives the first observation of the new episode. The disturbed observation never enters the
    dynamics. The dynamics receive the disturbed action, so the reward also depends on the disturbed
    action; the wrapped environment limits this action as it limits any action.

    With ``reward_from="observation"``, the reward is computed from the observation that the agent
    received before it acted (the paper's ``noise`` case); the reward's process acts after this.
    ``info["true_reward"]`` is always the reward of the true state, and ``info["true_observation"]``
    is the undisturbed observation.
    """

    def __init__(
        self,
        base: ComposableEnvironment,
        reward_from: str = "state",
        default_params: DisturbedParams | None = None,
    ) -> None:
        super().__init__()
        if reward_from not in REWARDS_FROM:
            raise UserError(
                f"reward_from={reward_from!r} must be one of {', '.join(REWARDS_FROM)}"
                f"{nearest(str(reward_from), REWARDS_FROM)}"
            )
        if reward_from == "observation" and not hasattr(base, "observed_reward"):
            raise UserError(
                f"reward_from='observation' needs an environment with observed_reward, "
                f"which {base.name} lacks"
            )
        self.base: Any = base
        self.reward_from = reward_from
        self._default_params = default_params

    def identity(self) -> tuple:
        """The wrapped environment, and the source of the reward."""
        return (self.base, self.reward_from)

    @property
    def default_params(self) -> DisturbedParams:
        """The parameters given at construction; without them, no process disturbs anything."""
        if self._default_params is not None:
            return self._default_params
        return DisturbedParams(env=self.base.default_params)

    def _size(self, params: DisturbedParams, full: int) -> int:
        """Elements of the disturbed observation; UserError if the process does not fit ``full``."""
        size = params.observation.output_size(full)
        if self.reward_from == "observation" and size != full:
            raise UserError(
                f"reward_from='observation' needs the full observation, of which "
                f"{type(params.observation).__name__} leaves {size} of {full} elements; "
                "use reward_from='state'"
            )
        return size

    def reset_env(
        self, key: jax.Array, params: DisturbedParams
    ) -> tuple[jax.Array, DisturbedState]:
        """Start an episode and all processes; returns the first observation [O] and the state."""
        key_env, *keys = jax.random.split(key, 3)
        with foreign_code():
            first, env = self.base.reset_env(key_env, params.env)
        return self._begin_episode(keys, jnp.asarray(first, jnp.float32), env, params)

    def reset_where(
        self, where: jax.Array, key: jax.Array, state: DisturbedState, params: DisturbedParams
    ) -> tuple[jax.Array, DisturbedState]:
        """The state of a simulator's new episode; the simulator is reset only if ``where`` is true.

        The arguments and results are otherwise those of `reset_env`.
        """
        key_env, *keys = jax.random.split(key, 3)
        first, env = self.base.reset_where(where, key_env, state.env, params.env)
        return self._begin_episode(keys, first, env, params)

    def step(
        self, key: jax.Array, state: object, action: ArrayLike, params: object = None
    ) -> tuple:
        """One step with automatic reset; a simulator is reset only at the end of an episode."""
        if not is_simulated(self):
            return super().step(key, state, action, params)
        params = self.default_params if params is None else params
        return step_with_reset(self, key, state, action, params)

    def _begin_episode(
        self,
        keys: Sequence[jax.Array],
        true_observation: jax.Array,
        env: object,
        params: DisturbedParams,
    ) -> tuple[jax.Array, DisturbedState]:
        """The first observation and state, from those of the wrapped environment."""
        key_init, key_process = keys
        with foreign_code():
            actions = _action_size(self.base, params.env)
        (full,) = true_observation.shape
        self._size(params, full)
        horizon = step_limit(params)
        process = params.observation.init(key_init, horizon, full)
        observation, process = params.observation.step(key_process, process, true_observation)
        state = DisturbedState(
            time=jnp.zeros((), jnp.int32),
            env=env,
            process=process,
            action=params.action.init(
                jax.random.fold_in(key_init, _ACTION_STREAM), horizon, actions
            ),
            reward=params.reward.init(jax.random.fold_in(key_init, _REWARD_STREAM), horizon, 1),
            observation=observation,
            true_observation=true_observation,
        )
        return observation, strong(state)

    def step_env(
        self,
        key: jax.Array,
        state: DisturbedState,
        action: ArrayLike,
        params: DisturbedParams,
    ) -> tuple[jax.Array, DisturbedState, jax.Array, jax.Array, dict[Any, Any]]:
        """One step without automatic reset; the observation [O] belongs to the same episode."""
        key_env, key_process = jax.random.split(key)
        key_action = jax.random.fold_in(key_process, _ACTION_STREAM)
        key_reward = jax.random.fold_in(key_process, _REWARD_STREAM)
        action = jnp.asarray(action, jnp.float32)
        applied, action_state = params.action.step(key_action, state.action, action.reshape(-1))
        applied = applied.reshape(action.shape)
        with foreign_code():
            true_observation, env, true_reward, terminated, info = self.base.step_env(
                key_env, state.env, applied, params.env
            )
        true_observation = jnp.asarray(true_observation, jnp.float32)
        reward = true_reward = jnp.asarray(true_reward, jnp.float32)
        if self.reward_from == "observation":
            reward = self.base.observed_reward(state.observation, applied, params.env)
        reward, reward_state = params.reward.step(key_reward, state.reward, reward.reshape(1))
        observation, process = params.observation.step(key_process, state.process, true_observation)
        evolved = DisturbedState(
            time=state.time + 1,
            env=env,
            process=process,
            action=action_state,
            reward=reward_state,
            observation=observation,
            true_observation=true_observation,
        )
        info = {
            **info,
            "true_reward": info.get("true_reward", true_reward),
            "true_observation": true_observation,
        }
        return observation, strong(evolved), reward.reshape(()), terminated, info

    def true_observation(self, state: DisturbedState, params: object = None) -> jax.Array:
        """The undisturbed observation [S] of a state."""
        return state.true_observation

    def is_terminated(self, state: DisturbedState, params: DisturbedParams) -> jax.Array:
        """Whether the wrapped environment terminated."""
        return self.base.is_terminated(state.env, params.env)

    def is_truncated(self, state: DisturbedState, params: DisturbedParams) -> jax.Array:
        """Whether the wrapped environment reached its time limit."""
        with foreign_code():
            return self.base.is_truncated(state.env, params.env)

    @property
    def name(self) -> str:
        """The name of the wrapped environment."""
        return self.base.name

    @property
    def num_actions(self) -> int:
        """Elements of an action."""
        return self.base.num_actions

    def action_space(self, params: DisturbedParams | None = None) -> Any:
        """The action space of the wrapped environment."""
        return self.base.action_space((self.default_params if params is None else params).env)

    def observation_space(self, params: DisturbedParams | None = None) -> spaces.Box:
        """A Box without bounds: a disturbed observation may leave the original bounds."""
        params = self.default_params if params is None else params
        size = self._size(params, _observation_size(self.base, params.env))
        return spaces.Box(-jnp.inf, jnp.inf, (size,), jnp.float32)


def disturb(
    env: EnvironmentLike, process: Process, channel: str = "observation", *, params: object = None
) -> Any:
    """``env`` with one channel passed through ``process``, which is drawn again in every episode.

    Call this function again to add other channels or processes. The processes of one channel act in
    the order in which they were added.

    Args:
        env: a gymnax >= 1.0 environment with a flat observation and a bounded Box of actions.
        process: a process of a signal: [O] (observation), [A] (flat action, in the environment's
            units) or [1] (reward).
        channel: "observation", "action" or "reward".
        params: the environment's parameters; its default parameters by default. The parameters
            and the process become the ``default_params`` of the returned environment.

    Raises:
        UserError: for a process that does not fit, or an environment that cannot be composed.
    """
    if channel not in CHANNELS:
        raise UserError(
            f"channel {channel!r} must be one of {', '.join(CHANNELS)}"
            f"{nearest(str(channel), CHANNELS)}"
        )
    if not isinstance(process, Process):
        raise UserError(
            f"{process!r} is not a process: make one of rtd.Dropout, rtd.Delay, ..., "
            "or inherit from rtd.Process"
        )
    process.validate()
    params = parameters_of(env, params)
    check_composable(env)
    base: Any = env
    reward_from = "state"
    if isinstance(env, Disturbed):
        base, reward_from = env.base, env.reward_from
    else:
        describe(env, params)
        params = DisturbedParams(env=params)
    assert isinstance(params, DisturbedParams)
    params = params.replace(**{channel: sequence(getattr(params, channel), process)})
    disturbed = Disturbed(base, reward_from, params)
    check_processes(disturbed)
    warn_if_it_begins_too_late(disturbed)
    return disturbed


def check_composable(env: object) -> None:
    """Raise UserError unless disturbances can be composed with the episodes of ``env``."""
    for method in ("reset_env", "step_env", "is_truncated"):
        if not callable(getattr(env, method, None)):
            raise UserError(
                f"{type(env).__name__} has no {method}, without which a disturbance cannot be "
                "composed with its episodes: inherit from gymnax's Environment"
            )


def with_true_reward(env: EnvironmentLike) -> EnvironmentLike:
    """``env`` with the reward of its true state, so that its return is the true return."""
    if not isinstance(env, Disturbed):
        return env
    params = env.default_params
    if env.reward_from == "state" and isinstance(params.reward, NoDisturbance):
        return env
    return Disturbed(env.base, "state", params.replace(reward=NoDisturbance()))


def warn_if_it_begins_too_late(env: Disturbed) -> None:
    """Warn about processes that begin at a random step, if the time limit is not known."""
    own = env.default_params
    limit = getattr(own.env, "max_steps_in_episode", None)
    if limit is not None and not (is_simulated(env.base) and limit == DEFAULT_STEP_LIMIT):
        return
    late = [type(process).__name__ for process in acting_processes(own) if process.begins_later]
    if late:
        remedy = (
            "pass max_steps_in_episode to rtd.from_gymnasium"
            if is_simulated(env.base)
            else "give the environment's parameters the field max_steps_in_episode"
        )
        warnings.warn(
            f"{' and '.join(late)} would begin at any of {DEFAULT_STEP_LIMIT:,} steps, because "
            f"{environment_name(env.base)} states no time limit: in shorter episodes it hardly "
            f"ever acts; {remedy}",
            stacklevel=3,
        )


def acting_processes(params: DisturbedParams) -> list[Process]:
    """The processes of all channels: the members of combinations, without `NoDisturbance`."""

    def members(process: Process) -> list[Process]:
        inner = getattr(process, "processes", None)
        if inner is not None:
            return [one for part in inner for one in members(part)]
        return [] if isinstance(process, NoDisturbance) else [process]

    return [one for channel in CHANNELS for one in members(getattr(params, channel))]


def sequence(*processes: Process) -> Process:
    """The processes in sequence, without nested or empty chains."""
    flat: list[Process] = []
    for process in processes:
        if not isinstance(process, NoDisturbance):
            flat += process.processes if isinstance(process, Chain) else [process]
    return Chain(tuple(flat)) if len(flat) > 1 else flat[0] if flat else NoDisturbance()


def seen_elements(env: EnvironmentLike, params: Any, size: int) -> list[int]:
    """The indices of the undisturbed observation's elements that the agent observes, in order.

    ``params`` are the parameters of ``env``, and ``size`` is the size of the undisturbed
    observation. The function knows only that `Hidden` removes an element. If the observation has
    another size than the returned list, then it is not known which elements the agent observes.
    """
    elements = list(range(size))
    return _left(params.observation, elements) if isinstance(env, Disturbed) else elements


def _left(process: Process, elements: list[int]) -> list[int]:
    """The ``elements`` that ``process`` does not remove."""
    if isinstance(process, Hidden):
        return [*elements[: process.element], *elements[process.element + 1 :]]
    if isinstance(process, Chain):
        for part in process.processes:
            elements = _left(part, elements)
    if isinstance(process, Mixture):
        each = [_left(member, elements) for member in process.processes]
        # If members remove different elements, the columns have no unique meaning.
        return each[0] if all(left == each[0] for left in each) else []
    return elements


def check_processes(env: Disturbed) -> None:
    """Raise UserError if a process of the default parameters does not fit its channel."""
    params = env.default_params
    env.observation_space(params)
    with foreign_code():
        actions = _action_size(env.base, params.env)
    for what, process, size in (("action", params.action, actions), ("reward", params.reward, 1)):
        if process.output_size(size) != size:
            raise UserError(
                f"{type(process).__name__} changes the number of elements, "
                f"which is not possible for the {what}"
            )


def _action_size(base: ComposableEnvironment, params: object) -> int:
    size = 1
    for length in base.action_space(params).shape:
        size *= length
    return size


def _observation_size(base: ComposableEnvironment, params: object) -> int:
    """Elements of the undisturbed observation; many environments do not declare its space."""
    with foreign_code():
        try:
            shape = base.observation_space(params).shape
        except (AttributeError, NotImplementedError):
            shape = ()
        if len(shape) == 1:
            return shape[0]
        key = jax.eval_shape(lambda: jax.random.key(0))
        return jax.eval_shape(base.reset_env, key, params)[0].shape[0]
