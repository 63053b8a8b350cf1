"""The devices on which workers train lanes, and the strategy that suits them."""

from typing import Any

import jax

from rtd3jax.system.machine import cores


def default_strategy() -> str:
    """``map`` on CPUs, ``vmap`` on accelerators."""
    return "map" if _default_device().platform == "cpu" else "vmap"


def workers() -> list[Any]:
    """The device of each worker: one worker per accelerator, or one per CPU core.

    On a CPU, all workers share JAX's single device. Their programs are compiled without Eigen's
    threads, so each core works on another lane, and no product is split (XLA's runtime may still
    move whole kernels between its threads). A second device would compile every program a second
    time. If XLA was configured to show several CPU devices, there is a worker for each.
    """
    first = _default_device()
    if first.platform == "cpu" and len(jax.local_devices(backend="cpu")) == 1:
        return [first] * cores()
    return jax.local_devices(backend=first.platform)


def _default_device() -> Any:
    """JAX's default device, which `jax_default_device` can set."""
    device = jax.config.values["jax_default_device"]
    if isinstance(device, str):  # the name of a platform
        return jax.local_devices(backend=device)[0]
    return device or jax.local_devices()[0]
