"""The rover with wheel slip (paper, Section 8.2)."""

from rtd3jax.envs.rover.environment import Rover, RoverParams, RoverState

__all__ = ["Rover", "RoverParams", "RoverState"]
