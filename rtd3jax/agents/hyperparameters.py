"""The traced numbers of a configuration, in which lanes of one program may differ."""

import dataclasses

import jax
from flax import struct


@struct.dataclass
class Hyperparameters:
    """Numbers float32 [], and the history length l, int32 []; see `rtd3jax.Config`."""

    actor_learning_rate: jax.Array
    critic_learning_rate: jax.Array
    final_learning_rate_fraction: jax.Array
    gamma: jax.Array
    reward_scale: jax.Array
    tau: jax.Array
    exploration_noise: jax.Array
    target_noise: jax.Array
    target_noise_clip: jax.Array
    actor_noise: jax.Array
    history_length: jax.Array

    def decayed(self, progress: jax.Array) -> "Hyperparameters":
        """These numbers after the fraction ``progress`` [] of all steps: learning rates decay."""
        scale = 1.0 - (1.0 - self.final_learning_rate_fraction) * progress
        return dataclasses.replace(
            self,
            actor_learning_rate=scale * self.actor_learning_rate,
            critic_learning_rate=scale * self.critic_learning_rate,
        )
