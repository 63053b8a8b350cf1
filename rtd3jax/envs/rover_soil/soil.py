"""Soils with their published parameters, and the properties of the soil under a wheel.

SI units, except that angles of soils are in degrees, as in the publications.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.envs.processes.process import float32, require

REFERENCE_SINKAGE = 0.01
"""m, the depth at which `LocalSoil` gives the pressure. Moduli with different exponents have
different units and cannot be interpolated; the pressures at one depth can be interpolated."""


class Soil(struct.PyTreeNode):
    """A soil in the model of Bekker, Wong and Reece, and Janosi and Hanamoto.

    The pressure below a plate of width b at depth z is ``(k_c / b + k_phi) z^n``. After the
    displacement j, the shear stress is ``(c + sigma tan(phi)) (1 - exp(-j / K))``. The normal
    stress below a driven wheel is greatest at ``(a_0 + a_1 slip)`` times the entry angle.
    """

    cohesion: float
    """c, Pa"""
    friction_angle: float
    """phi, degrees"""
    shear_modulus: float
    """K, m"""
    cohesive_modulus: float
    """k_c, N/m^(n+1)"""
    frictional_modulus: float
    """k_phi, N/m^(n+2)"""
    exponent: float
    """n"""
    peak_offset: float
    """a_0"""
    peak_slope: float
    """a_1"""
    exit_ratio: float
    """lambda: height above the lowest point of the wheel at which the contact ends behind the axle,
    divided by the sinkage; with 0, the contact ends below the axle"""

    def validate(self) -> None:
        """Raise UserError for a parameter beyond the range in which the model is used."""
        require(self, "cohesion", low=0, high=1e5)
        require(self, "friction_angle", low=0, high=50)
        require(self, "shear_modulus", low=1e-3, high=0.1)
        require(self, "cohesive_modulus", low=0, high=1e7)
        require(self, "frictional_modulus", low=1e4, high=1e8)
        require(self, "exponent", low=0.5, high=1.5)
        require(self, "peak_offset", low=0.1, high=0.7)
        require(self, "peak_slope", low=0, high=0.35)
        require(self, "exit_ratio", low=0, high=1.2)


DRY_SAND = Soil(
    cohesion=1040.0,
    friction_angle=28.0,
    shear_modulus=0.025,
    cohesive_modulus=990.0,
    frictional_modulus=1_528_430.0,
    exponent=1.1,
    peak_offset=0.18,
    peak_slope=0.32,
    exit_ratio=0.0,
)
"""Dry sand of the Land Locomotion Laboratory. k_c, k_phi, n, c and phi are from Wong, "Theory of
Ground Vehicles" (2008), Table 2.3. K is that of loose sand in the same book, which gives 1 cm for
firm sand to 2.5 cm for loose sand. a_0 and a_1 are those of loose sand in Wong and Reece, J.
Terramechanics 4(1), 1967, where the contact ends below the axle."""

REGOLITH = Soil(
    cohesion=800.0,
    friction_angle=37.2,
    shear_modulus=0.036,
    cohesive_modulus=1370.0,
    frictional_modulus=814_000.0,
    exponent=1.0,
    peak_offset=0.40,
    peak_slope=0.15,
    exit_ratio=0.9,
)
"""Lunar regolith simulant from Ishigami, Miwa, Nagatani and Yoshida, J. Field Robotics 24(3), 2007;
K is the published value for a zero slip angle."""


class LocalSoil(NamedTuple):
    """The soil under a wheel of a given width; all float32 arrays of one shape.

    Attributes:
        cohesion: c, Pa.
        friction: tan(phi).
        shear_modulus: K, m.
        pressure: at the depth ``REFERENCE_SINKAGE``, Pa.
        exponent: n.
        peak_offset: a_0.
        peak_slope: a_1.
        exit_ratio: lambda.
    """

    cohesion: jax.Array
    friction: jax.Array
    shear_modulus: jax.Array
    pressure: jax.Array
    exponent: jax.Array
    peak_offset: jax.Array
    peak_slope: jax.Array
    exit_ratio: jax.Array


def local_soil(soil: Soil, width: float | jax.Array) -> LocalSoil:
    """``soil`` below a wheel of ``width`` m; every field has shape []."""
    modulus = float32(soil.cohesive_modulus) / float32(width) + float32(soil.frictional_modulus)
    exponent = float32(soil.exponent)
    return LocalSoil(
        cohesion=float32(soil.cohesion),
        friction=jnp.tan(jnp.deg2rad(float32(soil.friction_angle))),
        shear_modulus=float32(soil.shear_modulus),
        pressure=modulus * float32(REFERENCE_SINKAGE) ** exponent,
        exponent=exponent,
        peak_offset=float32(soil.peak_offset),
        peak_slope=float32(soil.peak_slope),
        exit_ratio=float32(soil.exit_ratio),
    )
