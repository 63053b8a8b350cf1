"""The ground's fields: their statistics, and that they are fields of the place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtd3jax.envs.rover_soil import DRY_SAND, REGOLITH, Ground, field
from rtd3jax.envs.rover_soil.soil import local_soil
from rtd3jax.errors import UserError

WIDTH = jnp.float32(0.165)


@jax.jit
def grounds(ground, places, heading):
    """Soil [E, W] and slope [E] of 2,000 episodes at the same places."""

    def one(key):
        state = ground.init(key, 200, 2)
        return ground.at(state, places, heading, WIDTH)

    return jax.vmap(one)(jax.random.split(jax.random.key(0), 2_000))


def drawn(ground, places, heading=0.0):
    found = grounds(ground, jnp.asarray(places, jnp.float32), jnp.float32(heading))
    return jax.tree.map(np.asarray, found)


def floats(ground):
    return jax.tree.map(jnp.float32, ground)


def test_soil_varies_as_said_and_neighbours_go_together():
    distances = np.array([0.0, 0.5, 1.0, 3.0])
    soil, _ = drawn(floats(Ground()), np.stack([distances, 0.0 * distances], 1))
    logs = {
        "cohesion": np.log(soil.cohesion / 1040.0),
        "shear_modulus": np.log(soil.shear_modulus / 0.025),
        "pressure": np.log(soil.pressure / float(local_soil(DRY_SAND, 0.165).pressure)),
        "exponent": np.log(soil.exponent / 1.1),
        "friction_angle": np.degrees(np.arctan(soil.friction)) - 28.0,
    }
    for name, values in logs.items():
        deviation = getattr(field.SPREAD, name)
        assert values.mean() == pytest.approx(0.0, abs=0.1 * deviation), name
        assert values.std() == pytest.approx(deviation, rel=0.05), name
        along = [np.corrcoef(values[:, 0], values[:, k])[0, 1] for k in range(4)]
        np.testing.assert_allclose(along[:3], np.exp(-(distances[:3] ** 2) / 2), atol=0.15)
        assert abs(along[3]) < 0.3, name
    pairs = np.corrcoef([values[:, 0] for values in logs.values()])
    assert np.abs(pairs - np.eye(5)).max() < 0.08
    assert set(np.unique(soil.peak_offset)) == {np.float32(0.18)}


def test_a_field_is_one_of_the_place():
    ground = floats(Ground(slope=2.0))
    state = ground.init(jax.random.key(3), 200, 2)
    here = jnp.array([[1.0, 2.0], [1.0, 1.5]], jnp.float32)
    at = jax.jit(ground.at)
    one, _ = at(state, here, jnp.float32(0.0), WIDTH)
    back, _ = at(state, here[::-1], jnp.float32(2.0), WIDTH)
    np.testing.assert_allclose(one.pressure, back.pressure[::-1], rtol=1e-6)


def test_the_slope_is_the_heights_derivative_and_turns_with_the_heading():
    places = np.array([[0.0, 0.25], [0.0, -0.25]])
    east, west, north = (
        drawn(floats(Ground(slope=3.0)), places, heading)[1] for heading in (0.0, np.pi, np.pi / 2)
    )
    np.testing.assert_allclose(east, -west, atol=1e-6)
    assert np.degrees(east.std()) == pytest.approx(3.0, rel=0.1)
    assert np.degrees(north.std()) == pytest.approx(3.0, rel=0.1)
    assert abs(np.corrcoef(east, north)[0, 1]) < 0.1
    # The slope ahead integrates to the same height on two ways to one place.
    ground = floats(Ground(slope=3.0))
    state = ground.init(jax.random.key(5), 200, 2)

    @jax.jit
    def climbed(way):
        def ahead(place, step):
            heading = jnp.arctan2(step[1], step[0])
            slope = ground.at(state, place[None], heading, WIDTH)[1]
            return slope * jnp.hypot(step[0], step[1])

        return jnp.sum(jax.vmap(ahead)(0.5 * (way[1:] + way[:-1]), jnp.diff(way, axis=0)))

    t = np.linspace(0.0, 1.0, 400)
    direct = np.stack([3 * t, 2 * t], 1)
    bent = np.stack([3 * t, 2 * t**4 + np.sin(np.pi * t)], 1)
    rises = [float(climbed(jnp.asarray(way, jnp.float32))) for way in (direct, bent)]
    assert rises[0] == pytest.approx(rises[1], abs=2e-4)


def test_a_mixed_ground_has_both_soils():
    soil, _ = drawn(floats(Ground(DRY_SAND, REGOLITH, variation=0.0)), np.zeros((1, 2)))
    share = (soil.shear_modulus[:, 0] - 0.025) / 0.011
    assert share.min() < 0.02 and share.max() > 0.98
    assert share.mean() == pytest.approx(0.5, abs=0.03)
    same = 0.18 + share * 0.22
    np.testing.assert_allclose(soil.peak_offset[:, 0], same, atol=1e-5)


def test_no_variation_is_the_published_soil():
    soil, slope = drawn(floats(Ground(variation=0.0)), np.zeros((2, 2)))
    for found, published in zip(soil, local_soil(DRY_SAND, 0.165), strict=True):
        np.testing.assert_allclose(found, float(published), rtol=1e-5)
    np.testing.assert_array_equal(slope, 0.0)


@pytest.mark.parametrize(
    ("ground", "said"),
    [
        (Ground(variation=-1.0), "variation=-1.0 must be at least 0"),
        (Ground(correlation_length=0.0), "correlation_length=0.0 must be greater than 0"),
        (Ground(slope=40.0), "slope=40.0 must be at most 10"),
        (Ground(other=REGOLITH.replace(exponent=2.0)), "Soil: exponent=2.0 must be at most 1.5"),
    ],
)
def test_a_ground_without_sense_is_refused(ground, said):
    with pytest.raises(UserError, match=said):
        ground.validate()
