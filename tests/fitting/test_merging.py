"""Which regions are one surface."""

import numpy as np
import pytest

from jprimfit.fitting.merging import merge_regions
from jprimfit.fitting.regions import Region
from jprimfit.types import Plane

Z = np.array([0.0, 0, 1])
TOLERANCE = 0.01


@pytest.fixture
def merged(parts):
    """Merges the pieces of a part, each taken for one region; gives the surfaces and the pieces of each."""

    def merge(*pieces, sigma=0.0, guesses=None, tolerance=TOLERANCE):
        part = parts.join(*pieces)
        points = part.noisy(sigma)
        guesses = part.primitives if guesses is None else guesses
        regions = [Region(np.flatnonzero(part.labels == i), guess) for i, guess in enumerate(guesses)]
        surfaces = merge_regions(points, part.normals, regions, tolerance=tolerance)
        return part, surfaces, [sorted(set(part.labels[surface.rows].tolist())) for surface in surfaces]

    return merge


def plates(parts, *corners, sides=None, step=0.1):
    sides = sides or [(1, 1)] * len(corners)
    rng = np.random.default_rng(0)
    return [
        parts.rectangle(corner, (u, 0, 0), (0, v, 0), step=step, rng=rng)
        for corner, (u, v) in zip(corners, sides, strict=True)
    ]


def test_coplanar_plates_are_one_surface_and_parallel_ones_are_not(merged, parts):
    part, surfaces, pieces = merged(*plates(parts, (0, 0, 0), (3, 0, 0), (0, 0, 0.5), sides=[(1, 1), (1, 1), (1, 0.5)]))
    assert pieces == [[0, 1], [2]]
    np.testing.assert_array_equal(surfaces[0].rows, np.flatnonzero(part.labels < 2))
    assert parts.gap(surfaces[0].primitive, part.primitives[0]) < 1e-6


def test_surfaces_come_by_falling_size_and_no_row_is_lost(merged, parts):
    part, surfaces, pieces = merged(*plates(parts, (0, 0, 0), (0, 0, 1), (0, 0, 2), sides=[(0.5, 1), (1, 1), (2, 1)]))
    assert pieces == [[2], [1], [0]]
    np.testing.assert_array_equal(np.sort(np.concatenate([s.rows for s in surfaces])), np.arange(len(part.points)))


def test_a_plane_that_is_a_strip_of_a_cylinder_goes_home(merged, parts):
    rng = np.random.default_rng(0)
    half = parts.tube((0, 0, 0), 1.0, 1.5, step=0.1, rng=rng, turn=4.0)
    strip = parts.tube((0, 0, 0), 1.0, 1.5, step=0.05, rng=rng, start=4.5, turn=0.15)
    normal = np.array([np.cos(4.575), np.sin(4.575), 0])
    _, surfaces, pieces = merged(half, strip, guesses=[half[2], Plane(normal, np.float64(0.998))])
    assert pieces == [[0, 1]] and surfaces[0].primitive.kind == "cylinder"


def test_two_halves_known_badly_are_fitted_jointly(merged, parts):
    rng, sigma = np.random.default_rng(0), 0.02
    halves = [parts.tube((0, 0, 0), 1, 1.5, step=0.12, rng=rng, start=a, turn=3.0) for a in (0.0, np.pi)]
    true = halves[0][2]
    # Each half knows its radius by some per cent: beyond the tolerance where the other half lies.
    guesses = [true._replace(radius=1.02, center=np.array([0, -0.03, 0.0])), true._replace(radius=0.99)]
    _, surfaces, pieces = merged(*halves, sigma=sigma, guesses=guesses, tolerance=3 * sigma)
    assert pieces == [[0, 1]]
    assert parts.gap(surfaces[0].primitive, true) < 0.01


def test_cylinders_of_one_axis_and_two_radii_stay_apart(merged, parts):
    rng = np.random.default_rng(0)
    _, _, pieces = merged(*(parts.tube((0, 0, z), r, 1, step=0.1, rng=rng) for z, r in ((0, 1.0), (1, 0.9))))
    assert pieces == [[0], [1]]


def test_a_wall_through_a_plate_is_not_on_it_though_its_points_are_near(merged, parts):
    rng = np.random.default_rng(0)
    wall = parts.rectangle((0.5, 0, -0.01), (0, 1, 0), (0, 0, 0.02), step=0.02, rng=rng)
    _, _, pieces = merged(*plates(parts, (0, 0, 0), sides=[(2, 1)]), wall, tolerance=0.05)
    assert sorted(pieces) == [[0], [1]]


def test_no_region_no_surface():
    assert merge_regions(np.zeros((5, 3)), np.tile(Z, (5, 1)), [], tolerance=TOLERANCE) == []
