"""A digest of what the code of an environment computes, to notice that it has changed."""

import hashlib
import re
import warnings

import jax
import jax.numpy as jnp
import jaxlib

from rtd3jax.envs.compat.simulated import is_simulated
from rtd3jax.envs.interface import foreign_code
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.system.jax_settings import random_key, with_settings

_CALLS_PYTHON = re.compile(r"custom_call @\S*callback")
_FUNCTION = re.compile(r"func\.func private @([\w.]+)\(")


def code_of(env: EnvironmentLike, params: object) -> dict[str, str] | None:
    """A digest of the operations of reset and step, without the numbers of the parameters.

    Nothing is compiled. The result is None if there is nothing to compare: for an environment that
    calls Python while it runs, because the digest would not cover this Python code and would differ
    in every process; and for one that JAX cannot write for a CPU.

    Args:
        env: an environment that `rtd3jax.envs.interface.describe` accepts.
        params: its parameters.
    """
    if is_simulated(env):
        return None

    def both(key: jax.Array, state: object, action: jax.Array, params: object) -> tuple:
        return env.reset(key, params), env.step(key, state, action, params)

    # The text must not depend on the settings of the process, nor on its devices.
    with with_settings(()), foreign_code(), jax.disable_jit(False), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of 64-bit parameters
        try:
            key = random_key(0)
            state = jax.eval_shape(env.reset, key, params)[1]
            action = jax.ShapeDtypeStruct(env.action_space(params).shape, jnp.float32)
            traced = jax.jit(both).trace(key, state, action, params)
            text = traced.lower(lowering_platforms=("cpu",)).as_text()
        except Exception:  # kernels for accelerators only, for example
            return None
    if _CALLS_PYTHON.search(text):
        return None
    versions = f"{jax.__version__}, jaxlib {jaxlib.__version__}"
    digest = hashlib.sha256(_without_names(text).encode()).hexdigest()
    return {"jax": versions, "sha256": digest}


def is_other_code(before: dict[str, str] | None, now: dict[str, str] | None) -> bool:
    """Whether two results of `code_of` differ.

    Results of different versions of JAX count as equal: the text of the same code may differ.
    """
    if before is None or now is None or before["jax"] != now["jax"]:
        return False
    return before["sha256"] != now["sha256"]


def _without_names(text: str) -> str:
    """The text with numbers instead of the names of functions, which a user may change."""
    numbers = {name: str(place) for place, name in enumerate(_FUNCTION.findall(text))}
    return re.sub(r"@([\w.]+)", lambda found: f"@{numbers.get(found[1], found[1])}", text)
