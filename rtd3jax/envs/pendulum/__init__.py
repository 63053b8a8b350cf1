"""gymnax's pendulum, whose observation is disturbed."""

from rtd3jax.envs.pendulum.environment import Pendulum, PendulumParams, PendulumState

__all__ = ["Pendulum", "PendulumParams", "PendulumState"]
