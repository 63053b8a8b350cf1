"""What identifies a plant in files: its parameters and its options, JSON-ready."""

from typing import Any

import jax

from rtd3jax.envs.compat.simulated import is_simulated, simulated_identity
from rtd3jax.envs.identity import in_words
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.training.checkpoint import PLANT, named_numbers


def plant_of(env: EnvironmentLike, params: object) -> dict[str, Any]:
    """The identity of an environment with these parameters, equal in every process.

    Two plants with the same name differ in it if their parameters, their recordings or their static
    options differ. What the code of the environment computes is not part of it.
    """
    name = str(getattr(env, "name", type(env).__name__))
    # Static options are not among the parameters, such as the channel of a disturbance.
    options = in_words(env)
    if is_simulated(env):  # the observed elements, and the arguments of its construction
        name, options = simulated_identity(env), getattr(env, "reward_from", "")
    numbers = [named_numbers(leaf) for leaf in jax.tree.leaves(params)]
    return {"env": name, "params": numbers, PLANT: f"{options} with {in_words(params)}"}
