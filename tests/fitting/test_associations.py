"""Associations against shapes whose answer is known: lobed cylinders and spheres, a dented plate."""

import numpy as np
import pytest

import jprimfit


def lobed_cylinder(amplitude=0.05, radius=1.0):
    """Three lobes: the radius between radius - amplitude and radius + amplitude at every height."""
    turn, height = np.meshgrid(np.linspace(0, 2 * np.pi, 240, endpoint=False), np.linspace(-1, 1, 9))
    profile = radius + amplitude * np.cos(3 * turn)
    return np.stack([profile * np.cos(turn), profile * np.sin(turn), height], axis=-1).reshape(-1, 3)


@pytest.mark.parametrize(
    ("method", "radius"), [("minimum-zone", 1.0), ("maximum-inscribed", 0.95), ("minimum-circumscribed", 1.05)]
)
def test_a_lobed_cylinder(method, radius):
    points = 7.0 * lobed_cylinder() + [300.0, -50.0, 20.0]
    found, info = jprimfit.fit_primitive("cylinder", points, method=method)
    assert info.ok and info.method == method and np.all(np.isinf(info.covariance))
    assert float(found.radius) == pytest.approx(7.0 * radius, rel=1e-9)
    np.testing.assert_allclose(np.abs(found.axis), [0, 0, 1], atol=1e-8)
    np.testing.assert_allclose(found.center[:2], [300.0, -50.0], atol=1e-7)


@pytest.mark.parametrize("method", ["maximum-inscribed", "minimum-circumscribed", "minimum-zone"])
def test_a_sphere_touches_its_extreme_points(method):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(500, 3))
    points = directions / np.linalg.norm(directions, axis=1)[:, None] * rng.uniform(0.9, 1.1, (500, 1))
    found, info = jprimfit.fit_primitive("sphere", points, method=method)
    distance = np.linalg.norm(points - found.center, axis=1) - found.radius
    assert info.ok
    low, high = np.sort(distance)[:5], np.sort(distance)[::-1][:5]
    # Four unknowns are settled by four touching points (five where both sides count).
    if method == "maximum-inscribed":
        np.testing.assert_allclose(low[:4], 0, atol=1e-9)
    elif method == "minimum-circumscribed":
        assert np.all(distance < 1e-9) and np.sum(high > -1e-9) >= 2
    else:
        assert low[0] == pytest.approx(-high[0], abs=1e-9)
        assert np.sum(np.abs(np.abs(distance) - high[0]) < 1e-9) >= 5


def test_the_zone_of_a_plate_is_no_wider_than_that_of_any_direction():
    rng = np.random.default_rng(1)
    points = np.append(rng.uniform(-1, 1, (400, 2)), rng.uniform(-0.05, 0.05, (400, 1)), axis=1)
    found, info = jprimfit.fit_primitive("plane", points, method="minimum-zone")
    assert info.ok
    width = np.ptp(points @ found.normal)
    tilts = found.normal + 0.02 * rng.normal(size=(4000, 3))
    assert np.all(np.ptp(points @ (tilts / np.linalg.norm(tilts, axis=1)[:, None]).T, axis=0) >= width - 1e-12)
    assert np.max(points @ found.normal - found.offset) == pytest.approx(width / 2)
