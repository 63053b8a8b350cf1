"""Wheel slip (paper, Section 8.2): hidden from the agent, independent for the two wheels.

The input signal is the nominal speed of the wheels [2] in m/s, left and right. The output is the
realised speed, ``(1 - slip)`` times the nominal speed. The slip of step t acts on ``a_t`` and then
evolves. Every state has a field ``slip`` [2], the current slip.
"""

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.envs.processes.process import Process, float32, require, require_ordered

WHEELS = 2


class Ar1SlipState(struct.PyTreeNode):
    """The slip that acts in the next step."""

    slip: jax.Array
    """float32 [2]"""


class Ar1Slip(Process):
    """``s' = clip(rho*s + N(0, sigma^2), 0, max_slip)``, ``s_0 ~ U(0, max_slip)`` (paper, Exp1)."""

    rho: float = 0.95
    sigma: float = 0.05
    max_slip: float = 0.5

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> Ar1SlipState:
        """Draw the initial slip."""
        draw = jax.random.uniform(key, (WHEELS,), jnp.float32)
        return Ar1SlipState(slip=float32(self.max_slip) * draw)

    def step(
        self, key: jax.Array, state: Ar1SlipState, signal: jax.Array
    ) -> tuple[jax.Array, Ar1SlipState]:
        """Apply the slip, then draw the slip of the next step."""
        noise = float32(self.sigma) * jax.random.normal(key, (WHEELS,), jnp.float32)
        evolved = jnp.clip(float32(self.rho) * state.slip + noise, 0.0, float32(self.max_slip))
        return (1.0 - state.slip) * signal, Ar1SlipState(slip=evolved)

    def validate(self) -> None:
        """Check that the process is stationary and the slip is physically possible."""
        require(self, "rho", low=0, high=1)
        require(self, "sigma", low=0)
        require(self, "max_slip", low=0, high=1)


class ConstantSlip(Process):
    """The same constant slip of both wheels, for a test of robustness."""

    slip: float = 0.0

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> Ar1SlipState:
        """The slip, which has no random part."""
        return Ar1SlipState(slip=jnp.broadcast_to(float32(self.slip), (WHEELS,)))

    def step(
        self, key: jax.Array, state: Ar1SlipState, signal: jax.Array
    ) -> tuple[jax.Array, Ar1SlipState]:
        """Apply the slip."""
        return (1.0 - state.slip) * signal, state

    def validate(self) -> None:
        """Check that the slip is physically possible."""
        require(self, "slip", low=0, high=1)


class SineSlipState(struct.PyTreeNode):
    """The waves of an episode, one for each wheel."""

    slip: jax.Array
    """float32 [2], the slip that acts in the next step"""
    time: jax.Array
    """int32 []: step of the episode"""
    amplitude: jax.Array
    """float32 [2]"""
    period: jax.Array
    """float32 [2], a whole number of steps"""
    phase: jax.Array
    """float32 [2], rad"""


class SineSlip(Process):
    """``clip(A sin(2 pi t/T + phi) + offset, 0, max_slip)``, the "abstract" slip (paper, Exp2).

    A is uniform; T is uniform over the integers from period_min to period_max, both included; phi
    is uniform in [0, 2 pi). All are drawn for each wheel and episode.
    """

    amplitude_min: float = 0.08
    amplitude_max: float = 0.22
    period_min: int = 40
    period_max: int = 90
    offset: float = 0.12
    max_slip: float = 0.5

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> SineSlipState:
        """Draw the waves."""
        key_amplitude, key_period, key_phase = jax.random.split(key, 3)
        shape = (WHEELS,)
        period = jax.random.randint(
            key_period,
            shape,
            jnp.asarray(self.period_min, jnp.int32),
            jnp.asarray(self.period_max, jnp.int32) + 1,
            jnp.int32,
        ).astype(jnp.float32)
        amplitude = jax.random.uniform(
            key_amplitude,
            shape,
            jnp.float32,
            float32(self.amplitude_min),
            float32(self.amplitude_max),
        )
        phase = jax.random.uniform(key_phase, shape, jnp.float32, 0.0, 2.0 * jnp.pi)
        time = jnp.zeros((), jnp.int32)
        slip = self._slip(time, amplitude, period, phase)
        return SineSlipState(slip=slip, time=time, amplitude=amplitude, period=period, phase=phase)

    def _slip(
        self, time: jax.Array, amplitude: jax.Array, period: jax.Array, phase: jax.Array
    ) -> jax.Array:
        """Slip [2] at step ``time`` []."""
        angle = 2.0 * jnp.pi * time.astype(jnp.float32) / period + phase
        wave = amplitude * jnp.sin(angle) + float32(self.offset)
        return jnp.clip(wave, 0.0, float32(self.max_slip))

    def step(
        self, key: jax.Array, state: SineSlipState, signal: jax.Array
    ) -> tuple[jax.Array, SineSlipState]:
        """Apply the slip, then compute the slip of the next step."""
        time = state.time + 1
        slip = self._slip(time, state.amplitude, state.period, state.phase)
        return (1.0 - state.slip) * signal, state.replace(slip=slip, time=time)

    def validate(self) -> None:
        """Check the ranges."""
        require(self, "amplitude_min", low=0)
        require(self, "amplitude_max", low=0)
        require_ordered(self, "amplitude_min", "amplitude_max")
        require(self, "period_min", low=1)
        require(self, "period_max", low=1)
        require_ordered(self, "period_min", "period_max")
        require(self, "offset")
        require(self, "max_slip", low=0, high=1)
