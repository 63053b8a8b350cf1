"""The rover whose wheels slip."""

from rtd3jax.envs.rover.environment import Rover, RoverParams, RoverState

__all__ = ["Rover", "RoverParams", "RoverState"]
