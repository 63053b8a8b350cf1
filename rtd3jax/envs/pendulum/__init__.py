"""gymnax's pendulum, and the disturbances of its observation."""

from rtd3jax.envs.pendulum.environment import Pendulum, PendulumParams, PendulumState

__all__ = ["Pendulum", "PendulumParams", "PendulumState"]
