"""The start and the steps of episodes, which the modules `returns` and `rollout` share."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.envs.compat.simulated import fleet_of
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


class Part(struct.PyTreeNode):
    """The place of the episodes that are played together among all episodes of an evaluation."""

    first: jax.Array
    """int32 []: index of the first of them"""
    total: int = struct.field(pytree_node=False)
    """number of all episodes"""


def parts_of(env: EnvironmentLike, episodes: int) -> list[tuple[int, Part | None]]:
    """The numbers of episodes that are played together, one part after the other.

    Only a simulator limits these numbers; otherwise there is one number, without a `Part`.
    """
    fleet = fleet_of(env)
    # Lanes that train at the same time need simulators of the same fleet, too.
    most = episodes if fleet is None else max(1, fleet.most // 2)
    if episodes <= most:
        return [(episodes, None)]
    firsts = range(0, episodes, most)
    return [(min(most, episodes - k), Part(jnp.int32(k), episodes)) for k in firsts]


def _keys(key: jax.Array, episodes: int, part: Part | None) -> jax.Array:
    """A key for each of ``episodes``; an episode has the same key in a part and without parts."""
    if part is None:
        return jax.random.split(key, episodes)
    return jax.lax.dynamic_slice_in_dim(jax.random.split(key, part.total), part.first, episodes)


def begin_episodes(
    policy: PolicyLike,
    env: EnvironmentLike,
    params: object,
    key: jax.Array,
    episodes: int,
    part: Part | None = None,
) -> tuple[Any, Any, jax.Array, jax.Array]:
    """The states of policy and environment, the observations [episodes, O], and `take_step`'s key.

    ``part`` states which of the evaluation's episodes these are; by default all. For use under jit.
    """
    # With partitionable threefry, JAX's default, split(key, 3)[i] is fold_in(key, i). So with the
    # seed of a lane that has E environments, E of the episodes meet the disturbances of the lane's
    # first episodes. Other keys would change every published return.
    policy_key, reset_key, step_key = jax.random.split(key, 3)
    with foreign_code():
        observation, state = jax.vmap(env.reset, in_axes=(0, None))(
            _keys(reset_key, episodes, part), params
        )
    memory = jax.vmap(policy.init)(_keys(policy_key, episodes, part))
    return memory, state, observation.astype(jnp.float32), step_key


def take_step(
    env: EnvironmentLike,
    params: object,
    key: jax.Array,
    time: jax.Array,
    state: Any,
    action: jax.Array,
    part: Part | None = None,
) -> tuple[jax.Array, Any, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
    """Step ``time`` of each episode with ``action`` [episodes, ...].

    ``part`` is that of `begin_episodes`. For use under jit.

    Returns:
        Observations, float32 [episodes, O]; states; rewards, float32 [episodes]; terminated and
        truncated, bool [episodes]; and info.
    """
    keys = _keys(jax.random.fold_in(key, time), action.shape[0], part)
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
