"""The start and the steps of episodes, which the modules `returns` and `rollout` share."""

from typing import Any

import jax
import jax.numpy as jnp

from rtd3jax.envs.interface import Interface, describe, foreign_code
from rtd3jax.policies.compatibility import check_compatible, fitted
from rtd3jax.protocols import EnvironmentLike, PolicyLike


def check_fits(policy: PolicyLike, interface: Interface) -> None:
    """Raise UserError unless the policy fits the environment; warn if action bounds differ."""
    check_compatible(
        policy,
        interface.observation_size,
        interface.action_shape,
        interface.action_low,
        interface.action_high,
    )


def checked(policy: PolicyLike, env: EnvironmentLike, params: object) -> PolicyLike:
    """The policy, with actions of the environment's shape.

    Raises:
        UserError: for an unsuitable environment, or a policy that does not fit it.
    """
    interface = describe(env, params)
    check_fits(policy, interface)
    return fitted(policy, interface.action_shape)


def begin_episodes(
    policy: PolicyLike, env: EnvironmentLike, params: object, key: jax.Array, episodes: int
) -> tuple[Any, Any, jax.Array, jax.Array]:
    """The states of policy and environment, the observations [episodes, O], and `take_step`'s key.

    For use under jit.
    """
    # With partitionable threefry, JAX's default, split(key, 3)[i] is fold_in(key, i). So with the
    # seed of a lane that has E environments, E of the episodes meet the disturbances of the lane's
    # first episodes. Other keys would change every published return.
    policy_key, reset_key, step_key = jax.random.split(key, 3)
    with foreign_code():
        observation, state = jax.vmap(env.reset, in_axes=(0, None))(
            jax.random.split(reset_key, episodes), params
        )
    memory = jax.vmap(policy.init)(jax.random.split(policy_key, episodes))
    return memory, state, observation.astype(jnp.float32), step_key


def take_step(
    env: EnvironmentLike,
    params: object,
    key: jax.Array,
    time: jax.Array,
    state: Any,
    action: jax.Array,
) -> tuple[jax.Array, Any, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
    """Step ``time`` of each episode with ``action`` [episodes, ...].

    For use under jit.

    Returns:
        Observations, float32 [episodes, O]; states; rewards, float32 [episodes]; terminated and
        truncated, bool [episodes]; and info.
    """
    keys = jax.random.split(jax.random.fold_in(key, time), action.shape[0])
    with foreign_code():
        observation, state, reward, terminated, truncated, info = jax.vmap(
            env.step, in_axes=(0, 0, 0, None)
        )(keys, state, action, params)
    return (
        observation.astype(jnp.float32),
        state,
        jnp.asarray(reward, jnp.float32),  # or a Python number, if it is constant
        jnp.asarray(terminated, bool),
        jnp.asarray(truncated, bool),
        info,
    )
