"""The forces on one wheel, slow and obvious: float64, dense trapezoids, bisected sinkage."""

import numpy as np


def trapezoid(values, points):
    return float(np.sum((values[1:] + values[:-1]) * np.diff(points)) / 2)


def forces(soil, radius, width, entry, slip, points=20_001):
    """(vertical, pull, torque) of a driven wheel, as Ishigami et al. (2007) write them."""
    sinkage = radius * (1 - np.cos(entry))
    leave = -np.arccos(1 - soil.exit_ratio * sinkage / radius)
    peak = (soil.peak_offset + soil.peak_slope * slip) * entry
    theta = np.linspace(leave, entry, points)
    mapped = entry - (theta - leave) / (peak - leave) * (entry - peak)
    seen = np.where(theta >= peak, theta, mapped)
    modulus = soil.cohesive_modulus / width + soil.frictional_modulus
    rise = np.maximum(np.cos(seen) - np.cos(entry), 0)
    sigma = modulus * radius**soil.exponent * rise**soil.exponent
    j = radius * ((entry - theta) - (1 - slip) * (np.sin(entry) - np.sin(theta)))
    strength = soil.cohesion + sigma * np.tan(np.radians(soil.friction_angle))
    tau = strength * (1 - np.exp(-j / soil.shear_modulus))
    area = radius * width
    vertical = area * trapezoid(tau * np.sin(theta) + sigma * np.cos(theta), theta)
    pull = area * trapezoid(tau * np.cos(theta) - sigma * np.sin(theta), theta)
    return vertical, pull, area * radius * trapezoid(tau, theta)


def loaded(soil, radius, width, load, slip, points=4_001):
    """(sinkage, pull, torque) where the vertical force carries the load."""
    low, high = 0.0, radius
    for _ in range(50):
        middle = 0.5 * (low + high)
        entry = np.arccos(1 - middle / radius)
        if forces(soil, radius, width, entry, slip, points)[0] < load:
            low = middle
        else:
            high = middle
    return middle, *forces(soil, radius, width, entry, slip, points)[1:]
