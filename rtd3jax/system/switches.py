"""JAX's own switches that do not go with this package: each is one line, and the remedy.

Imported before anything that imports gymnax, which makes arrays on a device as it is imported.
"""

import os

import jax

from rtd3jax.errors import UserError, first_line

_GUARDS = ("", "_host_to_device", "_device_to_device", "_device_to_host")
_FORBIDDING = ("disallow", "disallow_explicit")


def check_switches() -> None:
    """Raise UserError where a switch would end a training or an evaluation half-way."""
    for direction in _GUARDS:
        name = f"jax_transfer_guard{direction}"
        if getattr(jax.config, name, None) in _FORBIDDING:
            raise UserError(
                f"{name.upper()} forbids what rtd3jax must do: its host hands programs their "
                "numbers and reads curves and checkpoints from them; use it around code of your "
                'own (with jax.transfer_guard("disallow"): ...), or set it to log'
            )


def check_compiling() -> None:
    """Raise UserError where nothing may be compiled: a training is one compiled program."""
    if jax.config.values["jax_disable_jit"]:
        raise UserError(
            "JAX_DISABLE_JIT does not go with training, which is one compiled program; to look "
            "into an environment, step it, evaluate a policy on it or check_env it without jit"
        )


def _import_gymnax() -> None:
    try:
        with jax.transfer_guard("allow"):
            import gymnax  # noqa: F401
    except (RuntimeError, AssertionError) as error:
        platforms = os.environ.get("JAX_PLATFORMS") or jax.config.values.get("jax_platforms")
        raise UserError(
            f"JAX finds no device with JAX_PLATFORMS={platforms or ''} ({first_line(error)}); "
            "unset it, or install JAX for that platform (rtd3jax[cuda13] for NVIDIA GPUs)"
        ) from None


_import_gymnax()
