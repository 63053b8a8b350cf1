"""Policies with random weights, large enough that a wrong gate or token has an effect."""

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.agents.agent import make_part
from rtd3jax.agents.bounds import Bounds
from rtd3jax.agents.networks import init_network
from rtd3jax.envs.interface import describe
from rtd3jax.policies.trained import Policy
from rtd3jax.registries import AGENTS

LENGTH = 3


def random_policy(
    algorithm,
    env,
    *,
    width=8,
    length=LENGTH,
    seed=0,
    scale=3.0,
    memory="lstm",
    acting="window",
    normaliser=None,
):
    """An untrained policy whose weights before the output are ``scale`` times their usual size."""
    interface = describe(env, env.default_params)
    length = 0 if algorithm == "td3" else length
    network = make_part(AGENTS[algorithm], "actor", memory, *interface.sizes, width)
    shapes = jax.eval_shape(lambda: init_network(jax.random.key(0), network))
    chance = np.random.default_rng(seed)

    def weights(layer, leaf):
        # Linear and LSTM layers alike, about `scale` times the usual size, but for the output:
        # actions shall not stand at their bounds.
        bound = width**-0.5 * (1 if layer[0].key == "output" else scale)
        return jnp.asarray(chance.uniform(-bound, bound, leaf.shape).astype(np.float32))

    actor = jax.tree_util.tree_map_with_path(weights, shapes)
    return Policy(
        actor=actor,
        bounds=Bounds(jnp.asarray(interface.action_low), jnp.asarray(interface.action_high)),
        history_length=jnp.int32(length),
        centre_token=jnp.zeros(interface.action_size),
        algorithm=algorithm,
        window_tokens=length
        + 2 * bool(length),  # as where lanes of several lengths share a program
        observation_size=interface.observation_size,
        action_shape=interface.action_shape,
        memory=memory,
        acting=acting,
        normaliser=normaliser,
    )
