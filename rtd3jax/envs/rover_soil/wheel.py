"""Forces of loose soil on one rigid wheel: Bekker, Wong and Reece, Janosi and Hanamoto.

The equations are those of Ishigami, Miwa, Nagatani and Yoshida, "Terramechanics-based model for
steering maneuver of planetary exploration rovers on loose soil", J. Field Robotics 24(3), 2007,
without a slip angle. SI units. Angles are in rad, from the vertical below the axle, and positive in
the driving direction. Soil touches the wheel from the entry angle to the exit angle, which is
behind the axle:

    normal stress   sigma = (k_c / b + k_phi) r^n (cos(theta) - cos(entry))^n     before the peak;
                    behind it, the same formula for theta mapped linearly from exit..peak to
                    entry..peak
    displacement    j = r ((entry - theta) - (1 - slip) (sin(entry) - sin(theta)))
    shear stress    tau = (c + sigma tan(phi)) (1 - exp(-j / K))
    vertical force  r b  integral of  tau sin(theta) + sigma cos(theta)
    drawbar pull    r b  integral of  tau cos(theta) - sigma sin(theta)
    torque          r^2 b  integral of  tau

At the sinkage ``r (1 - cos(entry))``, the vertical force equals the load.

This module also covers wheels that brake or turn backwards, which the source does not [choice].
``rolling`` is 1 for a wheel that rolls forwards and -1 for one that rolls backwards, and it passes
through 0 at rest. The displacement is then
``r (rolling ((entry - theta) - (sin(entry) - sin(theta))) + slip (sin(entry) - sin(theta)))``, and
the shear stress has its sign. For rolling = 1 and slip >= 0, this is the formula of the source.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from rtd3jax.envs.processes.process import float32, require
from rtd3jax.envs.rover_soil.soil import REFERENCE_SINKAGE, LocalSoil

NODES = 6
"""Gauss-Legendre nodes on each side of the peak of the normal stress."""
SMALLEST_ENTRY, LARGEST_ENTRY = 0.02, 1.5
"""rad, bounds of the entry angle. At the upper bound, the sinkage is nearly the wheel's radius; the
model is not valid beyond it."""


_Sums = tuple[jax.Array, jax.Array, jax.Array, jax.Array]


class Wheel(struct.PyTreeNode):
    """A rigid cylinder without grousers."""

    radius: float
    """m"""
    width: float
    """m"""

    def validate(self) -> None:
        """Raise UserError unless radius and width are positive."""
        require(self, "radius", above=0)
        require(self, "width", above=0)


class Forces(NamedTuple):
    """Forces of the soil on a wheel, each with the shape of the entry angle.

    Attributes:
        vertical: N, upwards.
        pull: N, drawbar pull, forwards.
        torque: N m, against the motor.
        torque_slope: N m, derivative of ``torque`` by the slip, for a fixed entry angle and a fixed
            peak of the normal stress.
    """

    vertical: jax.Array
    pull: jax.Array
    torque: jax.Array
    torque_slope: jax.Array


def contact_forces(
    soil: LocalSoil,
    wheel: Wheel,
    entry: jax.Array,
    slip: jax.Array,
    rolling: float | jax.Array = 1.0,
) -> Forces:
    """The forces on a wheel with the entry angle ``entry``; all arrays have the same shape.

    The stresses are integrated over the contact. Each node behind the peak is mapped to a node
    before the peak, so both have the same normal stress, which is computed once.
    """
    dtype = entry.dtype
    radius, width = (jnp.asarray(extent, dtype) for extent in (wheel.radius, wheel.width))
    rolling = jnp.asarray(rolling, dtype)
    driven = jnp.clip(slip * rolling, 0.0, 1.0)
    peak = (soil.peak_offset + soil.peak_slope * driven) * entry
    sin_entry, cos_entry = sine_of(entry), cosine_of(entry)
    before, behind = entry - peak, peak - exit_angle(soil, entry)
    scale = jnp.log(soil.pressure) + soil.exponent * jnp.log(radius / REFERENCE_SINKAGE)
    stiffness = radius / soil.shear_modulus

    def add(sums: _Sums, node: jax.Array) -> tuple[_Sums, None]:
        vertical, pull, torque, torque_slope = sums
        share, weight = node[0], node[1]
        ahead = peak + share * before
        rise = jnp.maximum(cosine_of(ahead) - cos_entry, 1e-9)
        sigma = jnp.exp(scale + soil.exponent * jnp.log(rise))
        strength = soil.cohesion + sigma * soil.friction
        for angle, extent in ((ahead, weight * before), (peak - share * behind, weight * behind)):
            sine, cosine = sine_of(angle), cosine_of(angle)
            lag = sin_entry - sine
            displacement = rolling * (entry - angle - lag) + slip * lag
            left = strength * jnp.exp(-stiffness * jnp.abs(displacement))
            tau = jnp.sign(displacement) * (strength - left) * extent
            normal = sigma * extent
            vertical += normal * cosine + rolling * tau * sine
            pull += tau * cosine - rolling * normal * sine
            torque += tau
            torque_slope += left * lag * extent
        return (vertical, pull, torque, torque_slope), None

    # Without a loop over the nodes, compilation and execution take four times as long.
    nodes = jnp.asarray(np.stack(unit_nodes(NODES), axis=1), dtype)
    zero = jnp.zeros_like(entry)
    sums, _ = jax.lax.scan(add, (zero, zero, zero, zero), nodes)
    vertical, pull, torque, torque_slope = sums
    area = radius * width
    return Forces(
        vertical=area * vertical,
        pull=area * pull,
        torque=area * radius * torque,
        torque_slope=area * radius * stiffness * torque_slope,
    )


def sine_of(angle: jax.Array) -> jax.Array:
    """The sine of an angle in [-pi/2, pi/2], by its series, which XLA vectorises; within 6e-8."""
    square = angle * angle
    series = _horner(square, (1.0, -1 / 6, 1 / 120, -1 / 5040, 1 / 362_880, -1 / 39_916_800))
    return angle * series


def cosine_of(angle: jax.Array) -> jax.Array:
    """The cosine of an angle in [-pi/2, pi/2]; see `sine_of`."""
    coefficients = (1.0, -1 / 2, 1 / 24, -1 / 720, 1 / 40_320, -1 / 3_628_800, 1 / 479_001_600)
    return _horner(angle * angle, coefficients)


def _horner(value: jax.Array, coefficients: tuple[float, ...]) -> jax.Array:
    """The polynomial with ``coefficients``, the lowest power first."""
    result = jnp.full_like(value, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        result = result * value + coefficient
    return result


def exit_angle(soil: LocalSoil, entry: jax.Array) -> jax.Array:
    """The exit angle, behind the axle, where the contact ends.

    This point lies lambda times the sinkage above the lowest point of the wheel, so the angle is
    ``-arccos(1 - lambda (1 - cos(entry)))``. The code uses sines of half angles, because float32
    rounds ``1 - cos`` of a small angle coarsely.
    """
    sine = jnp.minimum(_root(soil.exit_ratio) * sine_of(0.5 * entry), 1.0)
    return -2.0 * _arcsine(sine)


@jax.custom_jvp
def _root(value: jax.Array) -> jax.Array:
    """The square root, whose derivative at 0 is 0.

    A soil without an exit angle has the ratio 0 everywhere. The infinite derivative would make the
    gradients by the rover's place NaN.
    """
    return jnp.sqrt(value)


@_root.defjvp
def _root_derivative(
    values: tuple[jax.Array], changes: tuple[jax.Array]
) -> tuple[jax.Array, jax.Array]:
    (value,), (change,) = values, changes
    slope = jnp.where(value > 0.0, 0.5 / jnp.sqrt(jnp.where(value > 0.0, value, 1.0)), 0.0)
    return _root(value), slope * change


def _arcsine(sine: jax.Array) -> jax.Array:
    """The arcsine of a number from 0 to 1, within 2e-7 (Abramowitz and Stegun 1964, 4.4.46)."""
    series = _horner(sine, _ARCSINE)
    return 0.5 * jnp.pi - jnp.sqrt(1.0 - sine) * series


_ARCSINE = (
    *(1.5707963050, -0.2145988016, 0.0889789874, -0.0501743046),
    *(0.0308918810, -0.0170881256, 0.0066700901, -0.0012624911),
)


def static_entry_angle(soil: LocalSoil, wheel: Wheel, load: jax.Array) -> jax.Array:
    """Bekker's sinkage of a towed rigid wheel under ``load`` N, as an entry angle.

    ``z = (3 W / ((3 - n) b k sqrt(2 r)))^(2 / (2 n + 1))``, from Bekker, "Introduction to
    Terrain-Vehicle Systems" (1969): the soil's vertical reaction without shear, for small sinkages.
    """
    radius, width = float32(wheel.radius), float32(wheel.width)
    n = soil.exponent
    reference = soil.pressure * float32(REFERENCE_SINKAGE) ** -n
    ratio = 3.0 * load / ((3.0 - n) * width * reference * jnp.sqrt(2.0 * radius))
    depth = ratio ** (2.0 / (2.0 * n + 1.0)) / radius
    entry = 2.0 * _arcsine(jnp.sqrt(jnp.minimum(0.5 * depth, 1.0)))
    return jnp.clip(entry, SMALLEST_ENTRY, LARGEST_ENTRY)


def deeper(soil: LocalSoil, entry: jax.Array, vertical: jax.Array, load: jax.Array) -> jax.Array:
    """The next estimate of the entry angle at which the vertical force equals ``load``, in N.

    The estimate assumes that the force is proportional to the power 2 n + 1 of the entry angle.
    This is true without shear, and nearly true with it. So the iteration converges in few steps
    from above or below, and needs no derivative.
    """
    ratio = load / jnp.maximum(vertical, 1e-3 * load)
    moved = entry * jnp.exp(jnp.log(ratio) / (2.0 * soil.exponent + 1.0))
    return jnp.clip(moved, SMALLEST_ENTRY, LARGEST_ENTRY)


def entry_angle(
    soil: LocalSoil,
    wheel: Wheel,
    load: jax.Array,
    slip: jax.Array,
) -> jax.Array:
    """The entry angle at which the soil carries ``load`` N at ``slip``: the dynamic sinkage."""

    def closer(_: int, entry: jax.Array) -> jax.Array:
        vertical = contact_forces(soil, wheel, entry, slip).vertical
        return deeper(soil, entry, vertical, load)

    return jax.lax.fori_loop(0, 12, closer, static_entry_angle(soil, wheel, load))


def unit_nodes(count: int) -> tuple[list[float], list[float]]:
    """Gauss-Legendre nodes and weights on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (0.5 * (nodes + 1.0)).tolist(), (0.5 * weights).tolist()
