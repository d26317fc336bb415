"""The whole preprocessing: the map to the input, the frame, the report, small clouds."""

import json

import numpy as np
import pytest

from jprimfit.preprocessing.steps import STEP, nearest_rows, preprocess


def scan(num_points=1500, num_outliers=30):
    """A noisy sphere of radius 20 at (1000, 0, -500) with outliers around it, shuffled; rows of the outliers."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(num_points, 3))
    points *= (20 + 0.05 * rng.normal(size=(num_points, 1))) / np.sqrt((points**2).sum(axis=1, keepdims=True))
    points = np.concatenate([points, rng.uniform(-60, 60, (num_outliers, 3))]) + [1000.0, 0.0, -500.0]
    order = rng.permutation(len(points))
    return points[order], np.flatnonzero(order >= num_points)


def test_points_lead_back_to_their_rows():
    points, outliers = scan()
    done = preprocess(points, max_points=700, num_points=256)
    assert done.points.shape == (256, 3) and done.points.dtype == np.float32
    assert done.index.dtype == np.int32 and len(set(done.index.tolist())) == 256
    np.testing.assert_allclose(done.frame.to_input(done.points), points[done.index], atol=STEP * done.frame.scale)
    assert not set(done.index.tolist()) & set(done.removed.tolist())
    assert len(set(outliers.tolist()) & set(done.removed.tolist())) > 0.8 * len(outliers)
    assert done.removed.tolist() == sorted(done.removed.tolist())


def test_frame_is_that_of_what_the_filter_left():
    points, _ = scan()
    done = preprocess(points, max_points=5000)
    kept = np.delete(points, done.removed, axis=0)
    np.testing.assert_array_equal(np.sort(np.append(done.index, done.removed)), np.arange(len(points)))
    np.testing.assert_allclose(done.frame.center, kept.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(2 * done.frame.scale, np.ptp(kept @ done.frame.axes.T, axis=0).max(), rtol=1e-9)
    np.testing.assert_allclose(np.ptp(done.points, axis=0).max(), 2.0, rtol=1e-6)


def test_report_tells_what_happened_and_is_json():
    points, _ = scan()
    done = preprocess(points, max_points=700, num_points=256)
    report = json.loads(json.dumps(done.report))
    assert report["num_input"] == len(points) and report["num_output"] == 256
    assert report["num_removed"] == len(done.removed) > 0
    assert report["filter"]["mode"] == "auto" and report["filter"]["passes"] >= 1
    assert report["downsampled"] and not report["smoothed"]


def test_off_removes_nothing_and_on_removes_more_than_auto():
    points, _ = scan(num_outliers=0)
    assert len(preprocess(points, filter="off").removed) == len(preprocess(points, filter="auto").removed) == 0
    assert len(preprocess(points, filter="on").removed) > 0


def test_smoothing_moves_points_but_not_the_frame():
    points, _ = scan(num_outliers=0)
    raw, smooth = preprocess(points), preprocess(points, smooth=True)
    np.testing.assert_array_equal(raw.frame.center, smooth.frame.center)
    np.testing.assert_array_equal(raw.index, smooth.index)
    moved = np.abs(raw.points - smooth.points).max()
    assert 0 < moved < 0.1 and smooth.report["smoothed"]


@pytest.mark.parametrize("filter", ["auto", "on", "off"])
@pytest.mark.parametrize(
    "points", [np.eye(4)[:, :3], np.zeros((4, 3)), np.ones((1, 3)), np.arange(36.0).reshape(12, 3)]
)
def test_tiny_clouds(points, filter):
    done = preprocess(points, filter=filter, smooth=True)
    assert len(done.index) + len(done.removed) == len(points) and len(done.index) >= 1
    assert np.isfinite(done.points).all() and done.frame.scale > 0


def test_labels_go_to_the_nearest():
    points, _ = scan(num_outliers=0)
    done = preprocess(points, max_points=700, num_points=256)
    carried = nearest_rows(points[done.index], points)
    np.testing.assert_array_equal(carried[done.index], np.arange(256))
    nearest = [np.argmin(((points[done.index] - point) ** 2).sum(axis=1)) for point in points[:50]]
    np.testing.assert_array_equal(carried[:50], nearest)
