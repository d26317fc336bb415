"""Filtered normals: right beside an edge, where PCA mixes two faces, and the same in NumPy and JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry import host
from jprimfit.geometry.filtering import bilateral_normals
from jprimfit.geometry.hierarchy import nearest


def roof(noise, num=2000, seed=0):
    """Two faces at a right angle, with the true normals."""
    generator = np.random.default_rng(seed)
    points = np.concatenate([generator.uniform(0, 1, (num, 2)), np.zeros((num, 1))], axis=1)
    points[num // 2 :] = points[num // 2 :, [2, 1, 0]]
    truth = np.zeros((num, 3))
    truth[: num // 2, 2] = truth[num // 2 :, 0] = 1
    return (points + noise * generator.normal(size=points.shape)).astype(np.float32), truth


def pca(points, small=16, large=48):
    neighbors = host.knn(points, points, k=large)
    surface = host.pca_normals(points, k=small, neighbors=nearest(neighbors, k=small))
    return surface.normal.astype(np.float32), surface.curvature.astype(np.float32), neighbors


def mean_error(normals, truth):
    return np.degrees(np.arccos(np.clip(np.abs(np.sum(normals * truth, axis=1)), 0, 1))).mean()


@pytest.mark.parametrize(("noise", "gain"), [(0.0, 6.0), (0.003, 3.0), (0.01, 1.5)])
def test_edges_stay_sharp(noise, gain):
    points, truth = roof(noise)
    normal, curvature, neighbors = pca(points)
    found = bilateral_normals(points, normal, curvature, neighbors)
    assert gain * mean_error(found.normal, truth) < mean_error(normal, truth)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-5)
    assert found.normal.dtype == np.float32 and found.curvature.min() >= 0 and found.curvature.max() <= 1 / 3


def test_a_sphere_keeps_its_normals_and_bends():
    points = np.random.default_rng(1).normal(size=(2000, 3))
    points = (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
    normal, curvature, neighbors = pca(points)
    found = bilateral_normals(points, normal, curvature, neighbors)
    # Without an edge or noise there is nothing to gain: fewer neighbours speak than in PCA.
    assert mean_error(found.normal, points) < 2 * mean_error(normal, points)
    # The neighbours lie within 0.3 radians, so the mean squared sine is below a half of its square.
    assert 1e-4 < np.median(found.curvature) < 0.03


def test_signs_scale_and_padding_change_nothing():
    points, _ = roof(0.005, num=400)
    normal, curvature, neighbors = pca(points, small=8, large=20)
    expected = bilateral_normals(points, normal, curvature, neighbors)
    signs = np.random.default_rng(0).choice([-1, 1], (400, 1)).astype(np.float32)
    turned = bilateral_normals(points, normal * signs, curvature, neighbors)
    np.testing.assert_allclose(turned.normal, expected.normal * signs, atol=1e-4)
    larger = neighbors._replace(sq_distance=neighbors.sq_distance * 64.0)
    scaled = bilateral_normals(8 * points, normal, curvature, larger)
    np.testing.assert_allclose(scaled.normal, expected.normal, atol=1e-4)

    def padded(rows):
        return jnp.concatenate([jnp.asarray(rows), jnp.repeat(jnp.asarray(rows[:1]), 100, axis=0)])

    mask = jnp.arange(500) < 400
    found = jax.jit(bilateral_normals)(
        padded(points), padded(normal), padded(curvature), jax.tree.map(padded, neighbors), mask
    )
    np.testing.assert_allclose(found.normal[:400], expected.normal, atol=2e-4)
    np.testing.assert_allclose(found.curvature[:400], expected.curvature, atol=1e-4)


@pytest.mark.parametrize("points", [np.zeros((5, 3)), np.arange(15).reshape(5, 3) * [1, 0, 0]], ids=["copies", "line"])
def test_degenerate_neighbourhoods_give_finite_normals(points):
    points = points.astype(np.float32)
    normal, curvature, neighbors = pca(points, small=4, large=8)
    found = bilateral_normals(points, normal, curvature, neighbors)
    assert np.isfinite(found.normal).all() and np.isfinite(found.curvature).all()
