"""The paper's environments and the rover on soil; importing this module registers them."""

import rtd3jax.envs.pendulum.registration
import rtd3jax.envs.rover.registration
import rtd3jax.envs.rover_soil.registration  # noqa: F401
from rtd3jax.envs.registry import disturbances_of

ENVIRONMENTS: tuple[str, ...] = ("pendulum", "rover")
"""Ids of the paper's environments. `rtd3jax.make` also makes `rover-soil`, every gymnax id, and
Gymnasium's ids after ``gymnasium:``."""

DISTURBANCES: dict[str, tuple[str, ...]] = {env: disturbances_of(env) for env in ENVIRONMENTS}
"""The disturbances of each environment: the paper's (Sections 5.2 and 8.4), then ``FAULTS``.
Several are joined by ``+``, for example ``ar1-slip+dropout``."""

LISTED: dict[str, tuple[str, ...]] = {**DISTURBANCES, "rover-soil": disturbances_of("rover-soil")}
"""The disturbances of all environments of this package, for example for ``python -m rtd3jax``."""
