"""Faults of sensors, actuators and the wires between them; they fit any signal [N].

The paper has none of these. Time is counted in environment steps. What a process remembers is
drawn or cleared at the start of every episode.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.envs.processes.disturbances import check_elements, element_mask
from rtd3jax.envs.processes.process import Process, float32, require, require_ordered
from rtd3jax.errors import UserError


class Dropout(Process):
    """``dropout``: every step's signal is lost with probability ``p``, independently.

    A lost signal is lost whole. In its place comes the last one that arrived (``hold``), zeros
    before any has; or zeros always.
    """

    p: float = 0.1
    """Probability in [0, 1]."""
    hold: bool = struct.field(pytree_node=False, default=True)

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> jax.Array:
        """float32 [N], the last signal that arrived: none yet."""
        return jnp.zeros((size,), jnp.float32)

    def step(
        self, key: jax.Array, state: jax.Array, signal: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Let the signal through or not."""
        lost = jax.random.uniform(key, (), jnp.float32) < float32(self.p)
        shown = jnp.where(lost, state, signal)
        return shown, shown if self.hold else state

    def validate(self) -> None:
        """Check the probability."""
        require(self, "p", low=0, high=1)


class Delay(Process):
    """``delay``, ``action-delay``: what comes out is what went in ``steps`` steps before.

    Zeros come out until the first signal is through: no measurement, or no command.
    """

    steps: int = struct.field(pytree_node=False, default=2)

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> jax.Array:
        """float32 [steps, N], the signals under way, the oldest first."""
        return jnp.zeros((self.steps, size), jnp.float32)

    def step(
        self, key: jax.Array, state: jax.Array, signal: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Queue the signal; release the oldest."""
        queue = jnp.concatenate([state, signal[None].astype(jnp.float32)])
        return queue[0], queue[1:]

    def validate(self) -> None:
        """Check the number of steps."""
        require(self, "steps", low=0)
        if int(self.steps) != self.steps:
            raise UserError(f"Delay: steps={self.steps} must be a whole number")


class Quantisation(Process):
    """``quantisation``: every element is rounded to a multiple of ``resolution``, half to even.

    ``resolution`` is in the signal's own units: one number, or an array [N].
    """

    resolution: Any = 0.25

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> tuple[()]:
        """No state."""
        return ()

    def step(
        self, key: jax.Array, state: tuple[()], signal: jax.Array
    ) -> tuple[jax.Array, tuple[()]]:
        """Round."""
        resolution = jnp.broadcast_to(float32(self.resolution), signal.shape)
        return resolution * jnp.round(signal / resolution), state

    def validate(self) -> None:
        """Check the resolution."""
        require(self, "resolution", above=0)


class GainDrift(Process):
    """``gain-drift``: every element is multiplied by a gain of its own, a clipped random walk.

    ``g_0 = 1`` and ``g' = clip(g + N(0, sigma^2), gain_min, gain_max)``; the gain of step t acts on
    the signal of step t and then evolves. The gain has no unit, sigma is per step.
    """

    sigma: float = 0.02
    gain_min: float = 0.5
    gain_max: float = 1.5

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> jax.Array:
        """float32 [N], the gains: one, or as near to it as the limits allow."""
        return jnp.clip(
            jnp.ones((size,), jnp.float32), float32(self.gain_min), float32(self.gain_max)
        )

    def step(
        self, key: jax.Array, state: jax.Array, signal: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Multiply, then drift."""
        noise = float32(self.sigma) * jax.random.normal(key, state.shape, jnp.float32)
        evolved = jnp.clip(state + noise, float32(self.gain_min), float32(self.gain_max))
        return state * signal, evolved

    def validate(self) -> None:
        """Check the walk and its limits."""
        require(self, "sigma", low=0)
        require(self, "gain_min")
        require(self, "gain_max")
        require_ordered(self, "gain_min", "gain_max")


class OrnsteinUhlenbeck(Process):
    """``ornstein-uhlenbeck``: a bias that wanders about ``mean``, independent for each element.

    Stationary from the first step on, with standard deviation ``sigma`` (the signal's units) and
    autocorrelation ``exp(-k / time_constant)`` at a lag of k steps: the exact discretisation of
    Uhlenbeck & Ornstein's process (Physical Review 36, 1930).
    """

    sigma: float = 0.5
    time_constant: float = 20.0
    """Steps after which a deviation has fallen to 1/e."""
    mean: float = 0.0
    elements: tuple[int, ...] = struct.field(pytree_node=False, default=())
    """Those that are disturbed; () means all."""

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> jax.Array:
        """float32 [N], the bias, drawn from its stationary distribution."""
        noise = jax.random.normal(key, (size,), jnp.float32)
        return float32(self.mean) + float32(self.sigma) * noise

    def step(
        self, key: jax.Array, state: jax.Array, signal: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Add the bias, then let it wander."""
        mean = float32(self.mean)
        decay = jnp.exp(-1.0 / float32(self.time_constant))
        spread = float32(self.sigma) * jnp.sqrt(1.0 - decay**2)
        noise = jax.random.normal(key, state.shape, jnp.float32)
        evolved = mean + decay * (state - mean) + spread * noise
        size = signal.shape[-1]
        return signal + element_mask(self.elements or tuple(range(size)), size) * state, evolved

    def output_size(self, size: int) -> int:
        """Unchanged."""
        if self.elements:
            check_elements(self, self.elements, size)
        return size

    def validate(self) -> None:
        """Check the spread and the time constant."""
        require(self, "sigma", low=0)
        require(self, "time_constant", above=0)
        require(self, "mean")
        if self.elements:
            check_elements(self, self.elements)
