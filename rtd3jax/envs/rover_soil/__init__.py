"""The rover on loose soil."""

from rtd3jax.envs.rover_soil.environment import RoverSoil, RoverSoilParams, RoverSoilState
from rtd3jax.envs.rover_soil.field import Ground
from rtd3jax.envs.rover_soil.soil import DRY_SAND, REGOLITH, Soil

__all__ = [
    "DRY_SAND",
    "REGOLITH",
    "Ground",
    "RoverSoil",
    "RoverSoilParams",
    "RoverSoilState",
    "Soil",
]
