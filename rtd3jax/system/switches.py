"""JAX's switches with which this package cannot work: each is refused with a one-line error.

This module is imported before any module that imports gymnax: gymnax makes arrays on a device while
it is imported.
"""

import os

import jax

from rtd3jax.errors import UserError, short_reason

_GUARDS = ("", "_host_to_device", "_device_to_device", "_device_to_host")
_FORBIDDING = ("disallow", "disallow_explicit")


def check_switches() -> None:
    """Raise UserError if a switch would stop a training or an evaluation before its end."""
    for direction in _GUARDS:
        name = f"jax_transfer_guard{direction}"
        if getattr(jax.config, name, None) in _FORBIDDING:
            raise UserError(
                f"{name.upper()} forbids transfers that rtd3jax needs: the host sends numbers to "
                "the programs, and reads curves and checkpoints from them; use the guard around "
                'your own code (with jax.transfer_guard("disallow"): ...), or set it to log'
            )


def check_compiling() -> None:
    """Raise UserError if compilation is switched off: a training is one compiled program."""
    if jax.config.values["jax_disable_jit"]:
        raise UserError(
            "training cannot run with JAX_DISABLE_JIT: it is one compiled program; to debug an "
            "environment without jit, step it, evaluate a policy in it, or call check_env"
        )


def _import_gymnax() -> None:
    try:
        with jax.transfer_guard("allow"):
            import gymnax  # noqa: F401
    except (RuntimeError, AssertionError) as error:
        platforms = os.environ.get("JAX_PLATFORMS") or jax.config.values.get("jax_platforms")
        raise UserError(
            f"JAX finds no device with JAX_PLATFORMS={platforms or ''} ({short_reason(error)}); "
            "unset it, or install JAX for that platform (rtd3jax[cuda13] for NVIDIA GPUs)"
        ) from None


_import_gymnax()
