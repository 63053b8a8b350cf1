"""Recurrent TD3 agents for plants whose disturbance is hidden and evolves."""

from rtd3jax.config import ALGORITHMS, Config
from rtd3jax.errors import UserError

__all__ = ["ALGORITHMS", "Config", "UserError"]
