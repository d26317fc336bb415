"""Extents: ends without the bias of random samples and of noise, arcs, boxes and outlines of known shapes."""

import numpy as np
import pytest

from jprimfit.cad import extents
from jprimfit.cad.patches import patch
from jprimfit.types import Cone, Cylinder, Plane, Sphere

Z, ZERO = np.array([0.0, 0.0, 1.0]), np.zeros(3)


def _measured(primitive, points, blur=0.0):
    return extents.extents(primitive, points, patch(primitive, points), blur=blur)


def _around(angle, radius, height):
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


@pytest.mark.parametrize("blur", [0.0, 0.01, 0.05])
def test_ends_of_even_samples_have_no_bias(blur):
    random, low, high = np.random.default_rng(0), [], []
    for _ in range(300):
        values = random.uniform(-2, 3, 400) + blur * random.standard_normal(400)
        for found, value in zip((low, high), extents.ends(values, blur=blur), strict=True):
            found.append(value)
    # Of 400 points over a length of 5 the outermost lie 0.0125 inside the ends, or 0.1 outside under the larger noise.
    assert np.mean(low) == pytest.approx(-2, abs=0.015) and np.mean(high) == pytest.approx(3, abs=0.015)
    assert np.std(high) < 0.02 + 1.5 * blur


def test_noise_that_is_a_tenth_of_the_length_leaves_it_unbiased():
    random, lengths = np.random.default_rng(0), []
    for _ in range(200):
        low, high = extents.ends(random.uniform(0, 1, 1500) + 0.05 * random.standard_normal(1500), blur=0.05)
        lengths.append(high - low)
    assert np.mean(lengths) == pytest.approx(1, abs=0.01)


def test_ends_of_few_and_of_repeated_values():
    assert extents.ends(np.array([1.0, 2.0]), blur=0.0) == (1.0, 2.0)
    rows = np.repeat(np.linspace(0, 1, 11), 20)
    assert extents.ends(rows, blur=0.0) == pytest.approx((0.0, 1.0), abs=0.06)


def test_a_sparse_tail_is_not_drawn_out():
    values = np.concatenate([np.random.default_rng(0).uniform(0, 1, 500), np.linspace(1, 3, 12)])
    assert extents.ends(values, blur=0.05)[1] < 3.3


def test_a_turn_ends_where_its_points_end():
    angles = np.random.default_rng(0).uniform(-0.5, 2.0, 500)
    assert extents.turn(angles, gap=0.0, blur=0.0) == pytest.approx(2.5, abs=0.03)
    assert extents.turn(angles * 2 * np.pi / 2.5, gap=0.0, blur=0.0) == 2 * np.pi
    columns = np.repeat(np.arange(64) * 2 * np.pi / 64, 50)  # as a turntable leaves them
    assert extents.turn(columns, gap=0.15, blur=0.0) == 2 * np.pi
    assert extents.turn(columns[columns < 3.2], gap=0.15, blur=0.0) == pytest.approx(32 * 2 * np.pi / 64, abs=0.01)


def test_half_a_cylinder():
    random = np.random.default_rng(1)
    points = _around(random.uniform(0, np.pi, 5000), 2.0, random.uniform(1, 4, 5000))
    found = _measured(Cylinder(Z, ZERO, np.float64(2)), points)
    assert found["length"] == pytest.approx(3, rel=0.005) and found["arc"] == pytest.approx(np.pi, rel=0.005)
    assert found["area"] == pytest.approx(6 * np.pi, rel=0.02) and found["end_radii"] == (2.0, 2.0)
    np.testing.assert_allclose(found["ends"], [[0, 0, 1], [0, 0, 4]], atol=0.01)
    np.testing.assert_allclose(found["position"], [0, 0, 2.5], atol=0.01)


def test_strays_on_the_surface_beyond_its_end_do_not_count():
    random = np.random.default_rng(1)
    points = _around(random.uniform(0, 2 * np.pi, 5000), 2.0, random.uniform(1, 4, 5000))
    points[:2, 2] = 9.0, -5.0
    found = _measured(Cylinder(Z, ZERO, np.float64(2)), points)
    assert found["length"] == pytest.approx(3, rel=0.005) and found["arc"] == 2 * np.pi


def test_a_frustum_and_a_cone_with_its_tip():
    random = np.random.default_rng(2)
    cone = Cone(-Z, 5 * Z, np.float64(np.arctan(0.5)))
    for start in (2.0, 0.0):
        depth = np.sqrt(random.uniform(start**2, 16, 6000))
        found = _measured(cone, _around(random.uniform(0, 2 * np.pi, 6000), depth / 2, 5 - depth))
        assert found["end_radii"] == pytest.approx((start / 2, 2.0), abs=0.02)
        assert found["length"] == pytest.approx(4 - start, rel=0.01) and found["arc"] == 2 * np.pi
        slant = np.sqrt(1.25)
        assert found["area"] == pytest.approx(np.pi * slant * (4**2 - start**2) / 2, rel=0.015)


def test_a_cap_of_a_sphere_by_its_solid_angle():
    random = np.random.default_rng(3)
    up = random.uniform(0.5, 1, 4000)
    points = 3 * _around(random.uniform(0, 2 * np.pi, 4000), np.sqrt(1 - up**2), up)
    found = _measured(Sphere(ZERO, np.float64(3)), points)
    assert found["solid_angle"] == pytest.approx(np.pi, rel=0.015) and found["position"] is not None
    assert found["area"] == pytest.approx(9 * np.pi, rel=0.015)


def test_a_turned_plate_with_a_hole():
    random = np.random.default_rng(4)
    flat = random.uniform(-1, 1, (20_000, 2)) * [4, 2]
    flat = flat[np.hypot(flat[:, 0] - 2, flat[:, 1]) > 1]
    normal, across = np.array([0.6, 0, 0.8]), np.array([0.8, 0, -0.6])
    turned = np.stack(
        [np.cos(0.3) * across + np.sin(0.3) * np.eye(3)[1], np.cos(0.3) * np.eye(3)[1] - np.sin(0.3) * across]
    )
    plane, middle = Plane(normal, np.float64(7)), 7 * normal + across
    found = _measured(plane, middle + flat @ turned)
    assert found["length"] == pytest.approx(8, rel=0.01) and found["width"] == pytest.approx(4, rel=0.01)
    assert found["area"] == pytest.approx(32 - np.pi, rel=0.01)
    np.testing.assert_allclose(found["position"], middle, atol=0.03)
    hole = next(loop for loop in found["outline"] if loop.radius is not None)
    border = next(loop for loop in found["outline"] if loop.radius is None)
    assert len(found["outline"]) == 2 and hole.radius == pytest.approx(1, rel=0.02)
    np.testing.assert_allclose(hole.center, middle + 2 * turned[0], atol=0.03)
    assert np.ptp(border.corners @ normal) < 1e-9 and len(border.corners) < 40


def test_corners_are_not_cut_off_and_not_taken_for_a_circle():
    random = np.random.default_rng(5)
    points = random.uniform(-1, 1, (30_000, 3)) * [1, 1, 0]
    turns = [np.array([np.cos(a), np.sin(a), 0]) for a in np.arange(3) * np.pi / 3]
    hexagon = points[np.all([np.abs(points @ turn) < np.sqrt(0.75) for turn in turns], axis=0)]
    for number in (3000, 15_000):
        found = _measured(Plane(Z, np.float64(0)), hexagon[:number])
        assert found["length"] == pytest.approx(2, rel=0.02) and found["width"] == pytest.approx(np.sqrt(3), rel=0.01)
        assert found["outline"][0].radius is None


def test_a_disc_is_as_long_as_wide():
    random = np.random.default_rng(5)
    radius, angle = np.sqrt(random.uniform(0.25, 1, 8000)), random.uniform(0, 2 * np.pi, 8000)
    found = _measured(Plane(Z, np.float64(0)), _around(angle, radius, np.zeros(8000)))
    assert found["length"] == found["width"] == pytest.approx(2, rel=0.005)
    assert sorted(loop.radius for loop in found["outline"]) == pytest.approx([0.5, 1.0], rel=0.01)


def test_nothing_seen_is_a_position_without_extents():
    none = np.zeros((0, 3))
    found = _measured(Cylinder(Z, ZERO, np.float64(2)), none)
    assert found.keys() == {"area", "position"} and found["area"] == 0.0
    assert _measured(Plane(Z, np.float64(2)), none)["position"].tolist() == [0, 0, 2]
    two = np.array([[0.0, 0, 2], [1, 0, 2]])
    assert _measured(Plane(Z, np.float64(2)), two)["width"] == 0.0
