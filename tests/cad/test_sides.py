"""Holes and bosses: by the edges that surfaces share, by the volume inside, by what a surface on its own sees."""

import numpy as np
import pytest

from jprimfit.cad import sides
from jprimfit.cad.patches import patch
from jprimfit.types import Cylinder, Plane, Sphere

Z, ZERO = np.array([0.0, 0.0, 1.0]), np.zeros(3)
DENSITY = 600  # points per unit of area


def _tube(random, radius, low, high):
    n = int(DENSITY * 2 * np.pi * radius * (high - low))
    angle = random.uniform(0, 2 * np.pi, n)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), random.uniform(low, high, n)], axis=1)
    return Cylinder(Z, ZERO, np.float64(radius)), points


def _ring(random, inner, outer, height):
    n = int(DENSITY * np.pi * (outer**2 - inner**2))
    radius, angle = np.sqrt(random.uniform(inner**2, outer**2, n)), random.uniform(0, 2 * np.pi, n)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, height)], axis=1)
    return Plane(Z, np.float64(height)), points


def _ball(random, center, radius):
    normals = random.standard_normal((int(DENSITY * 4 * np.pi * radius**2), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Sphere(np.asarray(center), np.float64(radius)), center + radius * normals


def _outward(*segments):
    return sides.outward([patch(primitive, points) for primitive, points in segments]).tolist()


def _washer_with_spigot(random, *, base):
    """Outer wall, bore, the face around a spigot that stands on it, the spigot and its end; perhaps the base."""
    segments = [_tube(random, 2.0, 0, 1), _tube(random, 0.5, 0, 2), _ring(random, 1.2, 2.0, 1.0)]
    segments += [_tube(random, 1.2, 1, 2), _ring(random, 0.5, 1.2, 2.0)]
    return segments + [_ring(random, 0.5, 2.0, 0.0)] * base


def test_a_closed_part_tells_its_bore_from_its_walls():
    assert _outward(*_washer_with_spigot(np.random.default_rng(0), base=True)) == [1, -1, 1, 1, 1, -1]


def test_a_part_that_stands_on_a_table_does_so_too():
    assert _outward(*_washer_with_spigot(np.random.default_rng(0), base=False)) == [1, -1, 1, 1, 1]


def test_a_surface_that_touches_no_other_is_judged_by_what_surrounds_it():
    random = np.random.default_rng(0)
    part = _washer_with_spigot(random, base=True)
    cavity, ball = _ball(random, [1.25, 0, 0.5], 0.3), _ball(random, [5.0, 0, 0], 0.8)
    assert _outward(*part, cavity, ball)[-2:] == [-1, 1]


def test_a_wall_alone_may_be_a_hole_or_a_boss():
    random = np.random.default_rng(0)
    assert _outward(_tube(random, 1.0, 0, 2)) == [0]
    assert _outward(_ball(random, ZERO, 1.0)) == [1]
    assert _outward() == []


def test_a_pocket_without_the_part_around_it_is_not_taken_for_a_boss():
    random = np.random.default_rng(0)
    pocket = [_ring(random, 1.0, 2.5, 0.0), _tube(random, 1.0, -0.7, 0), _ring(random, 0.0, 1.0, -0.7)]
    assert _outward(*pocket) == [0, 0, 0]


def test_without_a_surface_nothing_is_told():
    few = Plane(Z, np.float64(0)), np.zeros((2, 3))
    assert _outward(few, few) == [0, 0]


@pytest.mark.parametrize(("place", "share"), [([0.1, 0.2, 0.3], 1.0), ([0.0, 0, 2], 0.0), ([0.0, 0, 1], 0.5)])
def test_the_winding_number_of_a_box(place, share):
    corners = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
    squares = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = corners[[[q[i] for i in three] for q in squares for three in ((0, 1, 2), (0, 2, 3))]]
    found = sides.winding(np.array([place]), triangles)
    np.testing.assert_allclose(found, share, atol=1e-12)
    np.testing.assert_allclose(sides.winding(np.array([place]), triangles[:, ::-1]), -share, atol=1e-12)
