"""The identity of a plant in files: its parameters and its options, JSON-ready."""

from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from rtd3jax.envs.compat.simulated import is_simulated, simulated_identity
from rtd3jax.envs.words import in_words
from rtd3jax.protocols import EnvironmentLike

MOST_NUMBERS = 1_000
"""Most numbers of an array that an identity contains; a longer array is replaced by its digest."""

PLANT = "plant"
"""Key of the part of an identity that earlier checkpoints do not have."""


def plant_of(env: EnvironmentLike, params: object) -> dict[str, Any]:
    """The identity of an environment with these parameters, equal in every process.

    The identities of two plants with the same name differ if their parameters, their recordings or
    the options of the environment differ. They do not contain what the code of the environment
    computes.
    """
    name = str(getattr(env, "name", type(env).__name__))
    if is_simulated(env):  # the observed elements, and the arguments of its construction
        name, options = simulated_identity(env), getattr(env, "reward_from", "")
    else:
        # Options, such as the channel of a disturbance, are not leaves of the parameters.
        options = in_words(env)
    numbers = [named_numbers(leaf) for leaf in jax.tree.leaves(params)]
    return {
        "env": name,
        "params": numbers,
        PLANT: f"{options} with {in_words(params, numbers=False)}",
    }


def named_numbers(leaf: ArrayLike) -> Any:
    """A parameter of an environment, JSON-ready: its numbers, or a digest if there are many.

    The numbers of a recording would make the header of every checkpoint too large.
    """
    array = np.asarray(leaf)
    return array.tolist() if array.size <= MOST_NUMBERS else in_words(array)
