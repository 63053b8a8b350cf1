"""An environment composed with a process that disturbs its observation (spec section 4)."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces

from rtd3jax.envs.identity import ValueIdentity, strong
from rtd3jax.envs.process import Nothing, Process
from rtd3jax.errors import UserError, nearest

REWARDS_FROM = ("state", "observation")


class DisturbedParams(struct.PyTreeNode):
    """Parameters of the environment below and of the process."""

    env: Any
    process: Process = Nothing()

    @property
    def max_steps_in_episode(self) -> int | jax.Array:
        """Episode length, which belongs to the environment below."""
        return self.env.max_steps_in_episode


class DisturbedState(struct.PyTreeNode):
    """One episode."""

    time: jax.Array
    """int32 []: steps taken"""
    env: Any
    """true state of the environment below"""
    process: Any
    """state of the disturbance, reset with the episode"""
    observation: jax.Array
    """float32 [O]: what the agent saw last"""


class Disturbed(ValueIdentity, environment.Environment):
    """``base`` with its observation passed through ``params.process``.

    The process sees the first observation of an episode, then one more at every step, the final
    one included; the observation after an automatic reset belongs to a newly drawn process. The
    dynamics never see it. ``reward_from="observation"`` computes the reward from the observation
    that the agent saw before it acted, the paper's ``noise`` case; ``info["true_reward"]`` is
    always that of the true state, ``info["true_observation"]`` the undisturbed observation.
    """

    def __init__(
        self,
        base: Any,
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
        self.base = base
        self.reward_from = reward_from
        self._default_params = default_params

    def identity(self) -> tuple:
        """The environment below and the source of the reward."""
        return (self.base, self.reward_from)

    @property
    def default_params(self) -> DisturbedParams:
        """Those given at construction, else an undisturbed environment's."""
        if self._default_params is not None:
            return self._default_params
        return DisturbedParams(env=self.base.default_params)

    def _size(self, params: DisturbedParams) -> int:
        """Elements of the observation; raises UserError if the process does not fit it."""
        full = self.base.observation_space(params.env).shape[0]
        size = params.process.output_size(full)
        if self.reward_from == "observation" and size != full:
            raise UserError(
                f"reward_from='observation' needs the full observation, of which "
                f"{type(params.process).__name__} leaves {size} of {full} elements; "
                "use reward_from='state'"
            )
        return size

    def reset_env(
        self, key: jax.Array, params: DisturbedParams
    ) -> tuple[jax.Array, DisturbedState]:
        """Start an episode of both; returns the first observation [O]."""
        self._size(params)
        key_env, key_init, key_process = jax.random.split(key, 3)
        true_observation, env = self.base.reset_env(key_env, params.env)
        process = params.process.init(key_init, params.max_steps_in_episode)
        observation, process = params.process.step(key_process, process, true_observation)
        state = DisturbedState(
            time=jnp.zeros((), jnp.int32), env=env, process=process, observation=observation
        )
        return observation, strong(state)

    def step_env(
        self,
        key: jax.Array,
        state: DisturbedState,
        action: Any,
        params: DisturbedParams,
    ) -> tuple[jax.Array, DisturbedState, jax.Array, jax.Array, dict[Any, Any]]:
        """One step of both; the observation [O] belongs to the episode even if it is its last."""
        key_env, key_process = jax.random.split(key)
        true_observation, env, true_reward, terminated, info = self.base.step_env(
            key_env, state.env, action, params.env
        )
        reward = true_reward
        if self.reward_from == "observation":
            reward = self.base.observed_reward(state.observation, action, params.env)
        observation, process = params.process.step(key_process, state.process, true_observation)
        evolved = DisturbedState(
            time=state.time + 1, env=env, process=process, observation=observation
        )
        info = {**info, "true_reward": true_reward, "true_observation": true_observation}
        return observation, strong(evolved), reward, terminated, info

    def is_terminated(self, state: DisturbedState, params: DisturbedParams) -> jax.Array:
        """Whether the environment below ended by itself."""
        return self.base.is_terminated(state.env, params.env)

    def is_truncated(self, state: DisturbedState, params: DisturbedParams) -> jax.Array:
        """Whether the environment below reached its time limit."""
        return self.base.is_truncated(state.env, params.env)

    @property
    def name(self) -> str:
        """The name of the environment below."""
        return self.base.name

    @property
    def num_actions(self) -> int:
        """Elements of an action."""
        return self.base.num_actions

    def action_space(self, params: DisturbedParams | None = None) -> Any:
        """That of the environment below."""
        return self.base.action_space((self.default_params if params is None else params).env)

    def observation_space(self, params: DisturbedParams | None = None) -> spaces.Box:
        """Unbounded: a disturbance may leave the bounds of the environment below."""
        size = self._size(self.default_params if params is None else params)
        return spaces.Box(-jnp.inf, jnp.inf, (size,), jnp.float32)
