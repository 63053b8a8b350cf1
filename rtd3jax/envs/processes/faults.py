"""Faults of sensors, actuators and their connections; they fit any signal [N].

The paper has none of these faults. Time is counted in environment steps. The state of a process is
drawn or cleared at the start of every episode.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.envs.processes.disturbances import check_elements, element_mask
from rtd3jax.envs.processes.process import (
    Process,
    float32,
    require,
    require_ordered,
    require_size,
    require_whole,
)


class Dropout(Process):
    """``dropout``: the signal of a step is lost with probability ``p``, independently.

    All elements of a signal are lost together. With ``hold``, the last signal that arrived replaces
    a lost signal; before any has arrived, zeros do. Without ``hold``, zeros always replace it.
    """

    p: float = 0.1
    """Probability in [0, 1]."""
    hold: bool = struct.field(pytree_node=False, default=True)

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> jax.Array:
        """float32 [N], the last signal that arrived: zeros at first."""
        return jnp.zeros((size,), jnp.float32)

    def step(
        self, key: jax.Array, state: jax.Array, signal: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Pass the signal on, or replace it."""
        lost = jax.random.uniform(key, (), jnp.float32) < float32(self.p)
        shown = jnp.where(lost, state, signal)
        return shown, shown if self.hold else state

    def validate(self) -> None:
        """Check the probability."""
        require(self, "p", low=0, high=1)


class Delay(Process):
    """``delay``, ``action-delay``: the output is the input of ``steps`` steps before.

    The output is zero until the first input arrives: no measurement, or no command.
    """

    steps: int = struct.field(pytree_node=False, default=2)

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> jax.Array:
        """float32 [steps, N], the delayed signals, the oldest first."""
        return jnp.zeros((self.steps, size), jnp.float32)

    def step(
        self, key: jax.Array, state: jax.Array, signal: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Put the signal in the queue; return the oldest signal."""
        queue = jnp.concatenate([state, signal[None].astype(jnp.float32)])
        return queue[0], queue[1:]

    def validate(self) -> None:
        """Check the number of steps."""
        require_whole(self, "steps", low=0)


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
        """Round the signal."""
        resolution = jnp.broadcast_to(float32(self.resolution), signal.shape)
        return resolution * jnp.round(signal / resolution), state

    def output_size(self, size: int) -> int:
        """Unchanged; UserError unless the resolution is one number or [size]."""
        require_size(self, size, "resolution")
        return size

    def validate(self) -> None:
        """Check the resolution."""
        require(self, "resolution", above=0)


class GainDrift(Process):
    """``gain-drift``: a gain multiplies each element; it is a clipped random walk.

    ``g_0 = 1`` and ``g' = clip(g + N(0, sigma^2), gain_min, gain_max)``; the gain of step t acts on
    the signal of step t and then evolves. The gain has no unit; sigma is the deviation per step.
    """

    sigma: float = 0.02
    gain_min: float = 0.5
    gain_max: float = 1.5

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> jax.Array:
        """float32 [N], the gains: one, clipped to the limits."""
        return jnp.clip(
            jnp.ones((size,), jnp.float32), float32(self.gain_min), float32(self.gain_max)
        )

    def step(
        self, key: jax.Array, state: jax.Array, signal: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Multiply the signal, then draw the next gains."""
        noise = float32(self.sigma) * jax.random.normal(key, state.shape, jnp.float32)
        evolved = jnp.clip(state + noise, float32(self.gain_min), float32(self.gain_max))
        return state * signal, evolved

    def output_size(self, size: int) -> int:
        """Unchanged; UserError unless the parameters are one number or [size] each."""
        require_size(self, size, "sigma", "gain_min", "gain_max")
        return size

    def validate(self) -> None:
        """Check the deviation and the limits of the gain."""
        require(self, "sigma", low=0)
        require(self, "gain_min")
        require(self, "gain_max")
        require_ordered(self, "gain_min", "gain_max")


class OrnsteinUhlenbeck(Process):
    """``ornstein-uhlenbeck``: a random bias around ``mean``, independent for each element.

    The bias is stationary, with standard deviation ``sigma`` (in the signal's units) and
    autocorrelation ``exp(-k / time_constant)`` at a lag of k steps: the exact discretisation of
    Uhlenbeck & Ornstein's process (Physical Review 36, 1930).
    """

    sigma: float = 0.5
    time_constant: float = 20.0
    """Steps after which a deviation has fallen to 1/e."""
    mean: float = 0.0
    elements: tuple[int, ...] = struct.field(pytree_node=False, default=())
    """Indices of the disturbed elements; () means all."""

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> jax.Array:
        """float32 [N], the bias, drawn from its stationary distribution."""
        noise = jax.random.normal(key, (size,), jnp.float32)
        return float32(self.mean) + float32(self.sigma) * noise

    def step(
        self, key: jax.Array, state: jax.Array, signal: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Add the bias, then draw the next bias."""
        mean = float32(self.mean)
        decay = jnp.exp(-1.0 / float32(self.time_constant))
        spread = float32(self.sigma) * jnp.sqrt(1.0 - decay**2)
        noise = jax.random.normal(key, state.shape, jnp.float32)
        evolved = mean + decay * (state - mean) + spread * noise
        size = signal.shape[-1]
        return signal + element_mask(self.elements or tuple(range(size)), size) * state, evolved

    def output_size(self, size: int) -> int:
        """Unchanged; UserError unless the parameters are one number or [size] each."""
        require_size(self, size, "sigma", "time_constant", "mean")
        if self.elements:
            check_elements(self, self.elements, size)
        return size

    def validate(self) -> None:
        """Check the standard deviation and the time constant."""
        require(self, "sigma", low=0)
        require(self, "time_constant", above=0)
        require(self, "mean")
        if self.elements:
            check_elements(self, self.elements)
