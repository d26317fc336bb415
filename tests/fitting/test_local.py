"""What neighbourhoods say of a surface: noise, normals, edges."""

import numpy as np
import pytest

from jprimfit.fitting.local import describe

NUM_POINTS = 1500


def surface(kind, seed):
    """Random points of a square or a sphere and their normals."""
    rng = np.random.default_rng(seed)
    if kind == "plane":
        return np.c_[rng.uniform(-1, 1, (NUM_POINTS, 2)), np.zeros(NUM_POINTS)], np.tile([0.0, 0, 1], (NUM_POINTS, 1))
    normals = rng.normal(size=(NUM_POINTS, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return 0.8 * normals, normals


def angles(found, true):
    """Degrees between lines."""
    return np.degrees(np.arccos(np.minimum(np.abs(np.sum(found * true, axis=1)), 1)))


@pytest.mark.parametrize("ratio", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("kind", ["plane", "sphere"])
def test_noise_is_that_of_the_scan(kind, ratio):
    points, normals = surface(kind, seed=1)
    sigma = ratio * describe(points).spacing
    scan = points + sigma * np.random.default_rng(2).normal(size=(NUM_POINTS, 1)) * normals
    described = describe(scan)
    assert described.noise == pytest.approx(sigma, rel=0.15)
    assert np.median(angles(described.normal, normals)) < 10
    np.testing.assert_allclose(np.linalg.norm(described.normal, axis=1), 1, atol=1e-12)


@pytest.mark.parametrize("name", ["boss", "ball_and_funnel", "fillet", "two_faces"])
def test_a_clean_scan_has_no_noise(parts, name):
    part = getattr(parts, name)()
    described = describe(part.points)
    assert described.noise < 0.005 * described.spacing
    smooth = described.core
    assert smooth.mean() > 0.5
    assert np.quantile(angles(described.normal[smooth], part.normals[smooth]), 0.95) < 2


def test_core_is_the_smooth_surface_and_not_the_edge(parts):
    part, step = parts.two_faces(), 0.08
    described = describe(part.points)
    from_edge = np.hypot(part.points[:, 0] - 3, part.points[:, 2])
    assert not described.core[from_edge < step].any()
    assert described.core[from_edge > 4 * step].all()
    # Without an edge there is no border either: the rims of a plate are smooth.
    plate = describe(part.points[part.labels == 0])
    assert plate.core.all() and plate.noise == pytest.approx(0, abs=1e-9)


def test_each_point_comes_first_among_its_neighbours(parts):
    points = parts.fillet().points
    index = describe(points).index
    np.testing.assert_array_equal(index[:, 0], np.arange(len(points)))
    assert all(len(set(row)) == len(row) for row in index)
    distance = np.linalg.norm(points[index] - points[:, None], axis=2)
    assert (np.diff(distance, axis=1) >= 0).all()
    others = np.linalg.norm(points[:1] - points[1:], axis=1)
    np.testing.assert_allclose(distance[0, 1:], np.sort(others)[: index.shape[1] - 1])


def test_measured_normals_are_taken_and_change_nothing_else(parts):
    part = parts.boss()
    scan = part.noisy(0.005)
    own, given = describe(scan), describe(scan, normals=part.normals)
    np.testing.assert_array_equal(given.normal, part.normals)
    assert np.abs(own.normal - part.normals).max() > 1e-3
    np.testing.assert_array_equal(given.core, own.core)
    assert (given.noise, given.spacing) == (own.noise, own.spacing)


def test_noise_and_spacing_that_are_known_are_kept(parts):
    described = describe(parts.fillet().points, noise=0.01, spacing=0.2)
    assert (described.noise, described.spacing) == (0.01, 0.2)


def test_position_does_not_matter_and_lengths_scale(parts):
    scan = parts.boss().noisy(0.01)
    here, there = describe(scan), describe(4.0 * scan + 1e3)
    assert there.noise == pytest.approx(4 * here.noise, rel=1e-6)
    assert there.spacing == pytest.approx(4 * here.spacing, rel=1e-6)
    np.testing.assert_allclose(there.residual, 4 * here.residual, rtol=1e-5, atol=1e-9)
    assert np.quantile(angles(there.normal, here.normal), 0.99) < 1e-3
    assert (there.core == here.core).mean() > 0.999


@pytest.mark.parametrize("num", [4, 5, 9])
def test_fewer_points_than_a_neighbourhood_holds(num):
    described = describe(np.random.default_rng(0).normal(size=(num, 3)))
    assert described.index.shape == (num, num)
    assert np.isfinite(described.normal).all() and np.isfinite(described.residual).all()
    assert np.isfinite(described.noise) and described.spacing > 0


def test_repeated_rows_are_not_taken_for_the_spacing(parts):
    points = parts.two_faces().points
    twice = describe(np.repeat(points, 2, axis=0))
    assert twice.spacing == pytest.approx(describe(points).spacing)
    assert np.isfinite(twice.normal).all() and twice.noise < 0.01 * twice.spacing


@pytest.mark.parametrize("thickness", [4, 6, 8])
@pytest.mark.parametrize("ratio", [1.0, 1.5, 2.0])
def test_the_other_side_of_a_thin_wall_is_not_noise(ratio, thickness):
    rng, half = np.random.default_rng(1), NUM_POINTS // 2
    plate = np.c_[rng.uniform(-1, 1, (NUM_POINTS, 2)), np.zeros(NUM_POINTS)]
    sigma = ratio * describe(plate[:half]).spacing
    plate[half:, 2] = thickness * sigma
    plate[:, 2] += sigma * rng.normal(size=NUM_POINTS)
    assert describe(plate).noise == pytest.approx(sigma, rel=0.3)
