"""The paper's environments, registered by import."""

import rtd3jax.envs.pendulum.registration
import rtd3jax.envs.rover.registration  # noqa: F401
from rtd3jax.envs.registry import disturbances_of

ENVIRONMENTS: tuple[str, ...] = ("pendulum", "rover")
"""The paper's environments. Every gymnax id can be made too."""

DISTURBANCES: dict[str, tuple[str, ...]] = {env: disturbances_of(env) for env in ENVIRONMENTS}
"""The disturbances of each environment: its own (paper, Sections 5.2 and 8.4), then ``FAULTS``.
They can be joined by ``+``: ``ar1-slip+dropout``."""
