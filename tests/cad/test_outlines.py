import numpy as np
import pytest

from jprimfit.cad import outlines


def rectangle(step):
    x, y = np.arange(0, 2, step), np.arange(0, 1, step)
    sides = [np.c_[x, 0 * x], np.c_[0 * y + 2, y], np.c_[2 - x, 0 * x + 1], np.c_[0 * y, 1 - y]]
    return np.concatenate(sides)


def ring(radius, n, noise=0.0):
    angle = np.arange(n) * 2 * np.pi / n
    radii = radius + noise * np.random.default_rng(0).uniform(-1, 1, n)
    return np.array([[3.0, -1.0]]) + np.stack([radii * np.cos(angle), radii * np.sin(angle)], axis=1)


def test_signed_area_is_positive_counter_clockwise_and_exact_far_away():
    loop = rectangle(0.1)
    assert outlines.signed_area(loop) == pytest.approx(2)
    assert outlines.signed_area(loop[::-1]) == pytest.approx(-2)
    assert outlines.signed_area(loop + np.array([[1e8, 1e8]])) == pytest.approx(2, rel=1e-6)


def test_a_rectangle_keeps_its_four_corners_wherever_the_loop_starts():
    for shift in range(0, 60, 7):
        corners = outlines.simplified(np.roll(rectangle(0.1), shift, axis=0), tolerance=0.01)
        assert sorted(map(tuple, np.round(corners, 9).tolist())) == [(0, 0), (0, 1), (2, 0), (2, 1)]
        assert outlines.signed_area(corners) == pytest.approx(2)


def test_dropped_corners_stay_within_the_tolerance():
    loop = ring(1.0, 200, noise=0.02)
    corners = outlines.simplified(loop, tolerance=0.05)
    ends = np.roll(corners, -1, axis=0)
    share = np.einsum("kc,jkc->jk", ends - corners, loop[:, None] - corners[None]) / np.sum(
        (ends - corners) ** 2, axis=1
    )
    nearest = corners[None] + np.clip(share, 0, 1)[..., None] * (ends - corners)[None]
    assert np.linalg.norm(loop[:, None] - nearest, axis=2).min(axis=1).max() <= 0.05
    assert len(corners) < 40
    np.testing.assert_array_equal(np.sort(outlines.simplified(loop, tolerance=0.0), axis=0), np.sort(loop, axis=0))


def test_degenerate_loops_are_survived():
    for loop in (np.zeros((4, 2)), np.array([[0.0, 0], [1, 0], [2, 0]]), np.array([[0.0, 0], [1, 0], [0, 1]])):
        assert np.isfinite(outlines.simplified(loop, tolerance=0.1)).all()
        assert outlines.circle(loop, tolerance=0.1) is None


def test_circles_are_recognised_and_squares_are_not():
    found = outlines.circle(ring(0.5, 60, noise=0.01), tolerance=0.02)
    assert found is not None
    np.testing.assert_allclose([*found.center, found.radius], [3, -1, 0.5], atol=0.004)
    assert outlines.circle(rectangle(0.05), tolerance=0.02) is None
    assert outlines.circle(ring(0.5, 60), tolerance=0.2) is None
