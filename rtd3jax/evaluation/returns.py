"""Evaluates any policy in any environment; equal seeds give equal episodes."""

import functools

import jax
import jax.numpy as jnp

from rtd3jax.envs.compat.simulated import release
from rtd3jax.envs.entry import parameters_of, step_limit
from rtd3jax.evaluation.play import Part, begin_episodes, checked, parts_of, take_step
from rtd3jax.protocols import EnvironmentLike, PolicyLike
from rtd3jax.system.jax_settings import random_key
from rtd3jax.system.numbers import check_counts
from rtd3jax.system.program_cache import make_room
from rtd3jax.system.pytrees import node_types


def evaluate(
    policy: PolicyLike,
    env: EnvironmentLike,
    episodes: int = 100,
    seed: int = 0,
    *,
    params: object = None,
    true_reward: bool = False,
) -> jax.Array:
    """Returns of whole episodes: float32 [episodes].

    Args:
        policy: anything with ``init`` and ``step``; see `rtd3jax.policies`.
        env: a gymnax >= 1.0 environment.
        episodes: number of episodes, played together; a simulator plays at most 512 of them
            together, and more of them in parts.
        seed: seed of the environment's random streams; equal seeds give equal starts and
            disturbances for all policies.
        params: the environment's parameters; its default parameters by default.
        true_reward: whether to sum the rewards of the undisturbed state, if the environment
            provides them.

    Raises:
        UserError: for an unsuitable environment or impossible arguments.
    """
    returns, true_returns = both_returns(policy, env, episodes, seed, params=params)
    return true_returns if true_reward else returns


def both_returns(
    policy: PolicyLike, env: EnvironmentLike, episodes: int, seed: int, *, params: object = None
) -> tuple[jax.Array, jax.Array]:
    """The returns and the returns of the undisturbed state, from the same episodes.

    Both are float32 [episodes]; `evaluate` returns one of the two.
    """
    check_counts(episodes, seed)
    params = parameters_of(env, params)
    policy = checked(policy, env, params)
    return unchecked_returns(policy, env, int(episodes), int(seed), params)


def unchecked_returns(
    policy: PolicyLike, env: EnvironmentLike, episodes: int, seed: int, params: object
) -> tuple[jax.Array, jax.Array]:
    """As `both_returns`, without checks."""
    make_room()
    types = node_types((policy, params))
    key = random_key(seed)
    played: list[tuple[jax.Array, jax.Array]] = []
    for count, part in parts_of(env, episodes):
        jax.block_until_ready(played)  # a part uses the simulators of the previous one
        played.append(_episode_returns(policy, env, params, key, count, part, types))
    if len(played) == 1:
        return played[0]
    returns, true_returns = (jnp.concatenate(both) for both in zip(*played, strict=True))
    return returns, true_returns


@functools.partial(jax.jit, static_argnames=("env", "episodes", "types"))
def _episode_returns(policy, env, params, key, episodes, part, types):
    return episode_returns(policy, env, params, key, episodes, part)


def episode_returns(
    policy: PolicyLike,
    env: EnvironmentLike,
    params: object,
    key: jax.Array,
    episodes: int,
    part: Part | None = None,
) -> tuple[jax.Array, jax.Array]:
    """As `both_returns`, float32 [episodes] each, without checks; for use under jit."""
    policy_state, env_state, observation, step_key = begin_episodes(
        policy, env, params, key, episodes, part
    )
    limit = step_limit(params)
    zeros = jnp.zeros((episodes,), jnp.float32)

    def unfinished(loop):
        time, alive, *_ = loop
        return jnp.any(alive) & (time < limit)

    def step(loop):
        time, alive, policy_state, env_state, observation, total, true_total = loop
        action, policy_state = jax.vmap(policy.step)(policy_state, observation)
        observation, env_state, reward, terminated, truncated, info = take_step(
            env, params, step_key, time, env_state, action, part
        )
        true = jnp.asarray(info.get("true_reward", reward), jnp.float32)
        total = total + jnp.where(alive, reward, 0.0)
        true_total = true_total + jnp.where(alive, true, 0.0)
        alive = alive & ~(terminated | truncated)
        return (
            time + jnp.int32(1),
            alive,
            policy_state,
            env_state,
            observation,
            total,
            true_total,
        )

    start = (
        jnp.int32(0),
        jnp.ones((episodes,), bool),
        policy_state,
        env_state,
        observation,
        zeros,
        zeros,
    )
    _, _, _, env_state, _, total, true_total = jax.lax.while_loop(unfinished, step, start)
    release(env, env_state)
    return total, true_total
