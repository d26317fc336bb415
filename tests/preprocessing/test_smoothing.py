"""Gaussian smoothing: the formula by a loop, less noise, the known shrinkage, degenerate clouds."""

import numpy as np
import pytest

from jprimfit.preprocessing.smoothing import gaussian_smooth, mean_spacing


def test_equals_a_loop():
    points = np.random.default_rng(0).normal(size=(40, 3))
    distance = np.sqrt(((points[:, None] - points[None]) ** 2).sum(axis=-1))
    sigma = 1.5 * np.sort(distance, axis=1)[:, 1].mean()
    expected = []
    for i in range(40):
        nearest = np.argsort(distance[i])[:7]
        weight = np.exp(-(distance[i, nearest] ** 2) / (2 * sigma**2))
        expected.append(weight @ points[nearest] / weight.sum())
    np.testing.assert_allclose(gaussian_smooth(points, k=7, bandwidth=1.5), expected, atol=1e-12)


def test_noise_of_a_plane_falls():
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.random((3000, 2)), 0.005 * rng.normal(size=3000)])
    smoothed = gaussian_smooth(points)
    # The mean of 16 nearly equal weights would leave a quarter of the noise.
    assert smoothed[:, 2].std() < 0.5 * points[:, 2].std()
    assert abs(smoothed[:, 2].mean()) < 1e-3


def test_a_sphere_shrinks_by_the_spread_over_the_diameter():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(4000, 3))
    points *= 5.0 / np.sqrt((points**2).sum(axis=1, keepdims=True))
    smoothed = gaussian_smooth(points, k=16, bandwidth=50.0)
    distance = np.sort(((points[:200, None] - points[None]) ** 2).sum(axis=-1), axis=1)[:, :16]
    radius = np.sqrt((smoothed[:200] ** 2).sum(axis=1))
    np.testing.assert_allclose((5.0 - radius).mean(), distance.mean() / (2 * 5.0), rtol=0.15)


def test_unit_and_position_do_not_matter():
    points = np.random.default_rng(3).normal(size=(50, 3))
    smoothed = gaussian_smooth(points)
    np.testing.assert_allclose(gaussian_smooth(points * 1e-6) * 1e6, smoothed, atol=1e-9)
    np.testing.assert_allclose(gaussian_smooth(points + 1e6) - 1e6, smoothed, atol=1e-8)


@pytest.mark.parametrize("points", [np.zeros((4, 3)), np.ones((1, 3))])
def test_coincident_points_stay(points):
    np.testing.assert_array_equal(gaussian_smooth(points), points)


def test_mean_spacing_of_a_grid():
    assert mean_spacing(np.array([[0.0, 4.0], [0.0, 4.0]])) == 2.0
    assert mean_spacing(np.zeros((3, 1))) == 0.0
