"""The outlier filter: Open3D's convention by a loop, and when "auto" decides to use it."""

import inspect

import numpy as np
import pytest

from jprimfit.preprocessing import outliers


def box_surface(num_points, seed=0):
    """Uniform points on the surface of a 2 x 2 x 2 box."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (num_points, 3))
    points[np.arange(num_points), rng.integers(0, 3, num_points)] = rng.choice([-1.0, 1.0], num_points)
    return points


def tube(num_points, seed=0):
    """Uniform points on an open cylinder of radius 0.4 and length 2 whose density grows tenfold along the axis."""
    rng = np.random.default_rng(seed)
    turn, along = rng.uniform(0, 2 * np.pi, num_points), 1 - 2 * np.sqrt(rng.uniform(0.01, 1, num_points))
    return np.column_stack([0.4 * np.cos(turn), 0.4 * np.sin(turn), along])


def with_outliers(points, share, seed=1):
    """The points followed by uniform outliers in their bounding box, and the number of these."""
    num = max(1, int(share * len(points)))
    low, high = points.min(axis=0), points.max(axis=0)
    return np.concatenate([points, np.random.default_rng(seed).uniform(low, high, (num, 3))]), num


def test_filter_equals_a_loop():
    points, _ = with_outliers(box_surface(300), 0.05)
    means = []
    for point in points:
        distance = np.sort(np.sqrt(((points - point) ** 2).sum(axis=1)))
        means.append(distance[:9].sum() / 9)  # nine, the point itself among them
    center = sum(means) / len(means)
    spread = np.sqrt(sum((mean - center) ** 2 for mean in means) / (len(means) - 1))
    expected = [mean < center + 1.5 * spread for mean in means]
    assert 0 < expected.count(False) < 100
    assert outliers.statistical_filter(points, k=9, deviations=1.5).tolist() == expected
    assert outliers.find_outliers(points, mode="on", k=9, deviations=1.5).keep.tolist() == expected


def test_filter_does_not_depend_on_unit_position_and_order():
    points, _ = with_outliers(box_surface(500), 0.05)
    order = np.random.default_rng(2).permutation(len(points))
    keep = outliers.statistical_filter(points)
    np.testing.assert_array_equal(outliers.statistical_filter(points * 1e-6), keep)
    np.testing.assert_array_equal(outliers.statistical_filter(points + 1e6), keep)
    np.testing.assert_array_equal(outliers.statistical_filter(points[order]), keep[order])


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.02])
@pytest.mark.parametrize("surface", [box_surface, tube])
@pytest.mark.parametrize("num_points", [100, 4000])
def test_auto_keeps_all_of_a_clean_cloud(surface, noise, num_points):
    points = surface(num_points)
    found = outliers.find_outliers(points + noise * np.random.default_rng(3).normal(size=points.shape))
    assert found.keep.all() and found.thresholds == ()


def test_auto_keeps_all_of_a_regular_grid():
    grid = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0), [0.0]), axis=-1).reshape(-1, 3)
    assert outliers.find_outliers(grid).keep.all()


@pytest.mark.parametrize("share", [0.01, 0.02, 0.05])
@pytest.mark.parametrize("surface,most_lost", [(box_surface, 0.001), (tube, 0.03)])
def test_auto_removes_most_outliers(surface, most_lost, share):
    points, num = with_outliers(surface(8192), share)
    found = outliers.find_outliers(points)
    removed = ~found.keep
    assert removed[-num:].mean() > 0.6
    assert removed[:-num].mean() < most_lost
    assert found.isolated_share > outliers.ISOLATED_SHARE and len(found.thresholds) >= 1


@pytest.mark.parametrize("mode", ["auto", "on", "off"])
@pytest.mark.parametrize(
    "points", [np.zeros((4, 3)), np.eye(4)[:, :3], np.arange(12.0).reshape(4, 3), np.zeros((1, 3)), np.zeros((40, 3))]
)
def test_tiny_and_degenerate_clouds_keep_a_point(points, mode):
    found = outliers.find_outliers(points, mode=mode)
    assert found.keep.any() and len(found.keep) == len(points)
    assert np.isfinite(found.isolated_share)


@pytest.mark.parametrize("mode", ["yes", True, None])
def test_another_mode_is_refused(mode):
    with pytest.raises(ValueError, match="'auto', 'on' and 'off'"):
        inspect.unwrap(outliers.find_outliers)(np.eye(4)[:, :3], mode=mode)  # without the type checks of the tests
