"""What a covariance lacks for being estimated: much where few points count most, nothing where many count alike."""

import numpy as np
import pytest

from jprimfit.evaluation import patches
from jprimfit.fitting import axial, kinds, newton, segments, spheres

PATCHES = {
    "sphere": patches.Patch("sphere", patches.SPHERE, (0.0, 1.0, 0.0, 6.28)),
    "cylinder": patches.Patch("cylinder", patches.CYLINDER, (-6.0, 6.0, 0.0, 1.6)),
    "cone": patches.Patch("cone", patches.CONE, (0.0, 6.0, 0.0, 1.6)),
}


def added(kind, num_points, seed=0):
    """What is added to the covariance, in its own standard errors."""
    rng = np.random.default_rng(seed)
    patch = PATCHES[kind]
    points = patch.draw(rng, num_points)
    given = segments.segment(points + 0.01 * patch.unit * rng.normal(size=points.shape))
    start = kinds.move(patch.truth, -given.anchor / given.size, 1.0 / given.size)
    module = spheres if kind == "sphere" else axial
    found = module.estimate(start, given.local, given.weights)
    assert found.ok
    doubted = module.with_doubt(found, given.local, given.weights)
    half = np.linalg.inv(np.linalg.cholesky(found.covariance))
    return half @ (doubted.covariance - found.covariance) @ half.T


@pytest.mark.parametrize("kind", PATCHES)
def test_fewer_points_leave_more_doubt(kind):
    few, many = (np.linalg.eigvalsh(added(kind, count)) for count in (100, 10_000))
    assert few.min() > -1e-9 and many.min() > -1e-9
    assert many.max() < 0.05 < few.max()


def test_a_cone_is_in_more_doubt_than_a_sphere():
    cone, sphere = (np.mean([np.trace(added(kind, 1_000, seed)) for seed in range(5)]) for kind in ("cone", "sphere"))
    assert cone > 3.0 * sphere


def test_of_very_many_points_there_is_none():
    assert not added("sphere", newton.MANY).any()
