"""The impairments of a signal in a test of robustness, with every strength a traced number.

All strengths are leaves of one pytree structure, so a policy needs one compiled program for noise,
lost readings and delays together. Tests of robustness use this process; in an environment, use
`GaussianNoise`, `Dropout` and `Delay`.
"""

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.envs.processes.disturbances import GaussianNoise
from rtd3jax.envs.processes.faults import Dropout
from rtd3jax.envs.processes.process import Process, require
from rtd3jax.errors import UserError

SHORTEST_QUEUE = 8
"""Steps that every queue can delay a signal, so that delays up to this number share a program."""


class VariableDelay(Process):
    """`Delay` with a traced number of steps: the output is zero until the first input arrives."""

    steps: int | jax.Array = 0
    longest: int = struct.field(pytree_node=False, default=SHORTEST_QUEUE)
    """Largest possible delay in steps."""

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> jax.Array:
        """float32 [longest, N], the last signals, the oldest first."""
        return jnp.zeros((self.longest, size), jnp.float32)

    def step(
        self, key: jax.Array, state: jax.Array, signal: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Put the signal in the queue; return the signal of ``steps`` steps before."""
        queue = jnp.concatenate([state, signal[None].astype(jnp.float32)])
        return queue[self.longest - jnp.asarray(self.steps, jnp.int32)], queue[1:]

    def validate(self) -> None:
        """Check the number of steps."""
        require(self, "steps", low=0, high=self.longest)
        if not isinstance(self.steps, jax.core.Tracer) and int(self.steps) != self.steps:
            raise UserError(f"VariableDelay: steps={self.steps} must be a whole number")


class Impairment(Process):
    """Noise, then lost readings, then a delay. By default, the signal passes unchanged.

    The members have the same key, so each acts as it would act alone. A test of robustness uses
    one of them at a time.
    """

    noise: GaussianNoise = GaussianNoise(0.0)
    dropout: Dropout = Dropout(0.0)
    delay: VariableDelay = VariableDelay()

    def init(
        self, key: jax.Array, horizon: int | jax.Array, size: int
    ) -> tuple[jax.Array, jax.Array]:
        """The states of the lost readings and of the delay."""
        return self.dropout.init(key, horizon, size), self.delay.init(key, horizon, size)

    def step(
        self, key: jax.Array, state: tuple[jax.Array, jax.Array], signal: jax.Array
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        """Pass the signal through the three members."""
        signal, _ = self.noise.step(key, (), signal)
        signal, held = self.dropout.step(key, state[0], signal)
        signal, queue = self.delay.step(key, state[1], signal)
        return signal, (held, queue)

    def validate(self) -> None:
        """Validate every member."""
        for process in (self.noise, self.dropout, self.delay):
            process.validate()
