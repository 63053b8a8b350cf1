"""The paper's environments; importing this module registers them."""

import rtd3jax.envs.pendulum.registration
import rtd3jax.envs.rover.registration  # noqa: F401
from rtd3jax.envs.registry import disturbances_of

ENVIRONMENTS: tuple[str, ...] = ("pendulum", "rover")
"""Ids of the paper's environments. `rtd3jax.make` also makes every gymnax id."""

DISTURBANCES: dict[str, tuple[str, ...]] = {env: disturbances_of(env) for env in ENVIRONMENTS}
"""The disturbances of each environment: the paper's (Sections 5.2 and 8.4), then ``FAULTS``.
Several are joined by ``+``, for example ``ar1-slip+dropout``."""
