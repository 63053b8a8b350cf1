"""Evaluates policies in Gymnasium's environments."""

import functools
from typing import Any

import gymnasium
import jax
import numpy as np
from jax.typing import ArrayLike

from rtd3jax.envs.compat.surface import within_bounds
from rtd3jax.envs.entry import DEFAULT_STEP_LIMIT
from rtd3jax.errors import UserError, short_reason
from rtd3jax.policies.compatibility import check_compatible, fitted
from rtd3jax.policies.trained import Policy
from rtd3jax.protocols import PolicyLike
from rtd3jax.system.numbers import check_counts
from rtd3jax.system.pytrees import node_types


def run_in_gymnasium(
    policy: PolicyLike, gym_env: gymnasium.Env | str, episodes: int = 10, seed: int = 0
) -> np.ndarray:
    """Returns of whole episodes: float64 [episodes].

    The action is clipped to the environment's bounds, and rounded if these are whole numbers. An
    episode that has not ended after 10,000 steps is cut.

    Args:
        policy: anything with ``init`` and ``step``; see `rtd3jax.policies`.
        gym_env: a ``gymnasium.Env`` with a Box of actions, or an id. A ``gymnasium.Env`` is not
            closed at the end.
        episodes: number of episodes, played one after the other.
        seed: seed of the episodes; with a larger ``episodes``, the first episodes stay the same.

    Raises:
        UserError: for spaces that do not fit the policy, or impossible arguments; at a step with an
            action or a reward that is not finite, or, for a policy of this package, with such an
            observation.
    """
    check_counts(episodes, seed)
    if not isinstance(gym_env, str):
        return _play(policy, gym_env, int(episodes), int(seed))
    try:
        env = gymnasium.make(gym_env)
    except (gymnasium.error.Error, ImportError, ValueError) as error:
        raise UserError(f"Gymnasium cannot make {gym_env!r}: {short_reason(error)}") from error
    try:
        return _play(policy, env, int(episodes), int(seed))
    finally:
        env.close()


def _play(policy: PolicyLike, env: gymnasium.Env, episodes: int, seed: int) -> np.ndarray:
    policy, space = _checked(policy, env)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    types = node_types(policy)
    returns = np.zeros(episodes)
    # Each episode gets its own seed, so that neighbouring values of ``seed`` share no episodes.
    for index, episode_seed in enumerate(np.random.SeedSequence(seed).generate_state(episodes)):
        observation, _ = env.reset(seed=int(episode_seed))
        state = policy.init(jax.random.key(int(episode_seed)))
        for step in range(DEFAULT_STEP_LIMIT):
            where = f"at step {step} of episode {index}"
            if isinstance(policy, Policy):
                _check_finite(where, "environment's observation", observation)
            action, state = _act(policy, state, np.asarray(observation, np.float32), types)
            _check_finite(where, "policy's action", action)
            command = within_bounds(np.asarray(action), low, high, space.dtype)
            observation, reward, terminated, truncated, _ = env.step(command)
            reward = float(reward)
            _check_finite(where, "environment's reward", reward)
            returns[index] += reward
            if terminated or truncated:
                break
    return returns


def _check_finite(where: str, what: str, value: ArrayLike) -> None:
    if not np.isfinite(np.asarray(value, np.float64)).all():
        raise UserError(f"{where} the {what} is {np.asarray(value).tolist()}, which is not finite")


@functools.partial(jax.jit, static_argnames="types")
def _act(
    policy: PolicyLike, state: object, observation: jax.Array, types: tuple[type, ...]
) -> tuple[jax.Array, Any]:
    return policy.step(state, observation)


def _checked(policy: PolicyLike, env: gymnasium.Env) -> tuple[Any, gymnasium.spaces.Box]:
    """The policy, with actions of the environment's shape, and the space of actions.

    Raises:
        UserError: if policy and environment do not fit together.
    """
    if not isinstance(env, gymnasium.Env):
        raise UserError(
            f"{type(env).__name__} is not a gymnasium.Env; for a gymnax environment use "
            "rtd.evaluate"
        )
    actions, observations = env.action_space, env.observation_space
    if not isinstance(actions, gymnasium.spaces.Box):
        raise UserError(f"the environment's actions are {actions}; a policy needs a Box")
    if not isinstance(observations, gymnasium.spaces.Box) or len(observations.shape) != 1:
        raise UserError(
            f"the environment's observations are {observations}; a policy needs a flat Box: "
            "wrap it in gymnasium.wrappers.FlattenObservation"
        )
    check_compatible(policy, observations.shape[0], actions.shape, actions.low, actions.high)
    policy = fitted(policy, actions.shape)
    kind = type(policy).__name__
    seen = jax.ShapeDtypeStruct(observations.shape, np.float32)
    try:
        key = jax.eval_shape(lambda: jax.random.key(0))
        act = functools.partial(_act, types=node_types(policy))
        shape = jax.eval_shape(act, policy, jax.eval_shape(policy.init, key), seen)[0].shape
    except TypeError as error:
        raise UserError(
            f"{kind} cannot be compiled; make it a flax.struct.dataclass: {short_reason(error)}"
        ) from error
    if shape != actions.shape:
        raise UserError(f"the policy's action has shape {shape}, the environment's {actions.shape}")
    return policy, actions
