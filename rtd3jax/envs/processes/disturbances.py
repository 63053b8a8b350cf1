"""Disturbances of an observation [O] (paper, Section 5.2). Time is counted in environment steps.

They change what the agent observes, never the true state. All random parameters are drawn once per
episode, unless a docstring says otherwise.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike

from rtd3jax.envs.processes.process import (
    Process,
    float32,
    require,
    require_ordered,
    require_size,
    require_whole,
)
from rtd3jax.errors import UserError
from rtd3jax.system.numbers import is_integer


def element_mask(elements: tuple[int, ...], size: int) -> np.ndarray:
    """A mask [O]: ones at the disturbed elements, zeros elsewhere."""
    mask = np.zeros(size, np.float32)
    mask[list(elements)] = 1.0
    return mask


def check_elements(process: object, elements: tuple[int, ...], size: int | None = None) -> None:
    """Raise UserError unless the elements are distinct indices of an observation of ``size``."""
    name = type(process).__name__
    if not isinstance(elements, tuple) or not all(map(is_integer, elements)):
        raise UserError(f"{name}: elements={elements!r} must be a tuple of indices, such as (0, 1)")
    if not elements or len(set(elements)) != len(elements) or min(elements) < 0:
        raise UserError(f"{name}: elements {elements} must be distinct, not negative, at least one")
    if size is not None and max(elements) >= size:
        raise UserError(f"{name}: element {max(elements)} is not in an observation of size {size}")


def _between(key: jax.Array, low: ArrayLike, high: ArrayLike, shape: tuple[int, ...]) -> jax.Array:
    """Uniform float32 random numbers between two parameters."""
    return jax.random.uniform(key, shape, jnp.float32, float32(low), float32(high))


class PulsesState(struct.PyTreeNode):
    """State of the placement of pulses in an episode; all fields are scalars []."""

    slots: jax.Array
    """int32: number of remaining places; a place is one free step or one whole pulse."""
    pulses: jax.Array
    """int32: number of pulses that have not begun."""
    running: jax.Array
    """int32: remaining steps of the active pulse, 0 between pulses."""
    amplitude: jax.Array
    """float32: amplitude of the last pulse."""


class Pulses(Process):
    """``temporal-bias``: short constant offsets at random steps (paper, Section 5.2).

    All placements of the pulses without overlap within the episode are equally likely. The process
    draws the placement step by step: a place becomes a pulse with probability (remaining pulses) /
    (remaining places). This is Knuth's selection sampling (TAOCP 3.4.2, algorithm S). A reset then
    takes almost no time, which matters because an automatic reset is computed at every step. If the
    episode is too short for all pulses, the pulses follow one another from its start to its end.
    """

    amplitude_min: float = 0.5
    amplitude_max: float = 1.0
    """The amplitude is drawn per pulse [choice]: the paper only gives the range."""
    count: int = struct.field(pytree_node=False, default=10)
    length: int = struct.field(pytree_node=False, default=3)
    elements: tuple[int, ...] = struct.field(pytree_node=False, default=(0, 1))

    begins_later: ClassVar[bool] = True

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> PulsesState:
        """The state in which no pulse has begun."""
        zero = jnp.zeros((), jnp.int32)
        return PulsesState(
            slots=jnp.asarray(horizon, jnp.int32) - self.count * (self.length - 1),
            pulses=zero + self.count,
            running=zero,
            amplitude=jnp.zeros((), jnp.float32),
        )

    def step(
        self, key: jax.Array, state: PulsesState, signal: jax.Array
    ) -> tuple[jax.Array, PulsesState]:
        """Decide whether a pulse begins; add the active pulse."""
        key_start, key_amplitude = jax.random.split(key)
        idle = state.running == 0
        draw = jax.random.uniform(key_start, (), jnp.float32) * state.slots.astype(jnp.float32)
        start = idle & (state.pulses > 0) & (draw < state.pulses.astype(jnp.float32))
        amplitude = jnp.where(
            start,
            _between(key_amplitude, self.amplitude_min, self.amplitude_max, ()),
            state.amplitude,
        )
        running = jnp.where(start, jnp.full_like(state.running, self.length), state.running)
        offset = jnp.where(running > 0, amplitude, jnp.zeros_like(amplitude))
        evolved = PulsesState(
            slots=state.slots - idle.astype(jnp.int32),
            pulses=state.pulses - start.astype(jnp.int32),
            running=jnp.maximum(running - 1, 0),
            amplitude=amplitude,
        )
        return signal + element_mask(self.elements, signal.shape[-1]) * offset, evolved

    def output_size(self, size: int) -> int:
        """Unchanged."""
        check_elements(self, self.elements, size)
        return size

    def validate(self) -> None:
        """Check the range of the amplitude and the counts."""
        require(self, "amplitude_min")
        require(self, "amplitude_max")
        require_ordered(self, "amplitude_min", "amplitude_max")
        require_whole(self, "count", low=0)
        require_whole(self, "length", low=1)
        check_elements(self, self.elements)


class SineState(struct.PyTreeNode):
    """The W waves of an episode."""

    time: jax.Array
    """int32 []: step of the episode."""
    amplitude: jax.Array
    """float32 [W]"""
    period: jax.Array
    """float32 [W], steps"""
    start: jax.Array
    """float32 [W], a whole number of steps"""


class Sine(Process):
    """Waves ``A sin(2 pi (t - t0)/T)`` of one period each (paper, Section 5.2).

    The defaults are ``random-sine``; ``temporal-sine`` fixes A = 1 and T = 70, ``combined-sine``
    has two waves. The start t0 is an integer, uniform over the steps after which a whole period
    fits into the episode [choice]; it is 0 if there is no such step.
    """

    amplitude_min: float = 0.5
    amplitude_max: float = 2.0
    period_min: float = 10.0
    period_max: float = 100.0
    elements: tuple[int, ...] = struct.field(pytree_node=False, default=(0, 1, 2))
    waves: int = struct.field(pytree_node=False, default=1)

    begins_later: ClassVar[bool] = True

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> SineState:
        """Draw amplitude, period and start of every wave."""
        key_amplitude, key_period, key_start = jax.random.split(key, 3)
        shape = (self.waves,)
        period = _between(key_period, self.period_min, self.period_max, shape)
        latest = jnp.floor(float32(horizon) - period).astype(jnp.int32)
        start = jax.random.randint(key_start, shape, 0, jnp.maximum(latest, 0) + 1, jnp.int32)
        return SineState(
            time=jnp.zeros((), jnp.int32),
            amplitude=_between(key_amplitude, self.amplitude_min, self.amplitude_max, shape),
            period=period,
            start=start.astype(jnp.float32),
        )

    def step(
        self, key: jax.Array, state: SineState, signal: jax.Array
    ) -> tuple[jax.Array, SineState]:
        """Add the sum of the active waves."""
        elapsed = state.time.astype(jnp.float32) - state.start
        wave = state.amplitude * jnp.sin(2.0 * jnp.pi * elapsed / state.period)
        active = (elapsed >= 0.0) & (elapsed < state.period)
        offset = jnp.sum(jnp.where(active, wave, jnp.zeros_like(wave)))
        evolved = state.replace(time=state.time + 1)
        return signal + element_mask(self.elements, signal.shape[-1]) * offset, evolved

    def output_size(self, size: int) -> int:
        """Unchanged."""
        check_elements(self, self.elements, size)
        return size

    def validate(self) -> None:
        """Check the ranges of amplitude and period."""
        _validate_wave(self)
        require_whole(self, "waves", low=1)


class DampedSine(Process):
    """``exp(-(t - t0)/T) A sin(2 pi (t - t0)/T)`` from t0 to the end (paper, Section 5.2).

    t0 is uniform over the episode's steps; A and T are drawn as for ``random-sine``.
    """

    amplitude_min: float = 0.5
    amplitude_max: float = 2.0
    period_min: float = 10.0
    period_max: float = 100.0
    elements: tuple[int, ...] = struct.field(pytree_node=False, default=(0, 1, 2))

    begins_later: ClassVar[bool] = True

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> SineState:
        """Draw amplitude, period and start of the wave."""
        key_amplitude, key_period, key_start = jax.random.split(key, 3)
        start = jax.random.randint(key_start, (1,), 0, jnp.asarray(horizon, jnp.int32), jnp.int32)
        return SineState(
            time=jnp.zeros((), jnp.int32),
            amplitude=_between(key_amplitude, self.amplitude_min, self.amplitude_max, (1,)),
            period=_between(key_period, self.period_min, self.period_max, (1,)),
            start=start.astype(jnp.float32),
        )

    def step(
        self, key: jax.Array, state: SineState, signal: jax.Array
    ) -> tuple[jax.Array, SineState]:
        """Add the wave, which is zero before its start."""
        elapsed = jnp.maximum(state.time.astype(jnp.float32) - state.start, 0.0)
        cycles = elapsed / state.period
        offset = jnp.sum(state.amplitude * jnp.exp(-cycles) * jnp.sin(2.0 * jnp.pi * cycles))
        evolved = state.replace(time=state.time + 1)
        return signal + element_mask(self.elements, signal.shape[-1]) * offset, evolved

    def output_size(self, size: int) -> int:
        """Unchanged."""
        check_elements(self, self.elements, size)
        return size

    def validate(self) -> None:
        """Check the ranges of amplitude and period."""
        _validate_wave(self)


def _validate_wave(process: Sine | DampedSine) -> None:
    """Raise UserError unless amplitude, period and elements are valid."""
    require(process, "amplitude_min")
    require(process, "amplitude_max")
    require_ordered(process, "amplitude_min", "amplitude_max")
    require(process, "period_min", above=0)
    require(process, "period_max", above=0)
    require_ordered(process, "period_min", "period_max")
    check_elements(process, process.elements)


class GaussianNoise(Process):
    """``noise``: independent N(0, sigma^2) on every element at every step (paper, Section 5.2)."""

    sigma: float = 0.5

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> tuple[()]:
        """No state: the noise is white."""
        return ()

    def step(
        self, key: jax.Array, state: tuple[()], signal: jax.Array
    ) -> tuple[jax.Array, tuple[()]]:
        """Add the noise."""
        noise = jax.random.normal(key, signal.shape, jnp.float32)
        return signal + float32(self.sigma) * noise, state

    def output_size(self, size: int) -> int:
        """Unchanged; UserError unless sigma is one number or [size]."""
        require_size(self, size, "sigma")
        return size

    def validate(self) -> None:
        """Check sigma."""
        require(self, "sigma", low=0)


class Hidden(Process):
    """``hidden``: removes an element, by default the angular velocity (paper, Section 5.2)."""

    element: int = struct.field(pytree_node=False, default=2)

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> tuple[()]:
        """No state."""
        return ()

    def step(
        self, key: jax.Array, state: tuple[()], signal: jax.Array
    ) -> tuple[jax.Array, tuple[()]]:
        """Remove the element: [O] -> [O-1]."""
        return jnp.concatenate([signal[: self.element], signal[self.element + 1 :]]), state

    def output_size(self, size: int) -> int:
        """``size`` minus one."""
        check_elements(self, (self.element,), size)
        return size - 1

    def validate(self) -> None:
        """Check the element."""
        require_whole(self, "element", low=0)
        check_elements(self, (self.element,))
