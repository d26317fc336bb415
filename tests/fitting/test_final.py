"""The parameters that are reported: without the bias that least squares has under noise, and never worse by much."""

import numpy as np
import pytest

from jprimfit.evaluation import patches
from jprimfit.fitting import final, kinds
from jprimfit.types import Cylinder, Plane, Sphere

WHOLE = {patch.truth.kind: patch for patch in patches.WHOLE}


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_radii_under_noise_are_right_in_the_mean_and_those_of_least_squares_are_not(kind):
    before, after = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        points = WHOLE[kind].draw(rng, 4000)
        points = points + 0.6 * rng.normal(size=points.shape)
        fitted = kinds.fit(kind, points, np.zeros_like(points), np.arange(4000), start=WHOLE[kind].truth)
        before.append(float(fitted.primitive.radius) - 6.0)
        after.append(float(final.settled(fitted.primitive, points).radius) - 6.0)
    spread = np.std(after) / np.sqrt(len(after))
    assert abs(np.mean(after)) < 3.5 * spread < abs(np.mean(before))


def test_clean_points_give_the_surface_to_all_digits():
    rng = np.random.default_rng(0)
    for patch in patches.WHOLE:
        points = patch.draw(rng, 500) + 50.0
        start = kinds.move(patch.truth, np.full(3, 50.0), 1.0)
        fitted = kinds.fit(patch.truth.kind, points, np.ones_like(points), np.arange(500), start=start)
        found = final.settled(fitted.primitive, points)
        assert np.abs(kinds.distances(found, points)).max() < 1e-5
        if not isinstance(found, Plane | Cylinder):
            np.testing.assert_allclose(found[1], start[1], atol=1e-9)
        if not isinstance(found, Plane):
            assert float(found[-1]) == pytest.approx(float(start[-1]), abs=1e-9)


def test_stray_points_of_a_drawn_segment_do_not_count():
    rng = np.random.default_rng(0)
    points = WHOLE["cylinder"].draw(rng, 1000) + 0.01 * rng.normal(size=(1000, 3))
    points[:50] += rng.uniform(-1, 1, (50, 3))
    start = Cylinder(patches.CYLINDER.axis, patches.CYLINDER.center, np.float64(6.02))
    wary, trusting = final.settled(start, points, noise=0.01), final.settled(start, points)
    assert abs(wary.radius - 6.0) < 0.01 and abs(wary.radius - 6.0) < abs(trusting.radius - 6.0)


def test_what_the_points_do_not_tell_stays_as_it_was():
    rng = np.random.default_rng(0)
    flat = rng.normal(size=(300, 3)) * [1.0, 1.0, 0.0]
    sphere = Sphere(np.array([0.0, 0.0, 5.0]), np.float64(5.0))
    assert final.settled(sphere, flat) is sphere
    assert final.settled(sphere, np.zeros((5, 3))) is sphere
    blob = rng.normal(size=(300, 3))
    small = Sphere(np.zeros(3), np.float64(1.6))
    found = final.settled(small, blob)
    rms = [np.sqrt(np.mean(kinds.distances(one, blob) ** 2)) for one in (small, found)]
    assert rms[1] <= 1.05 * rms[0]
