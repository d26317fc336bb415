"""PCA normals in JAX: known surfaces, the host twin, derivatives, degenerate neighbourhoods."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry import host, normals
from jprimfit.geometry.neighbors import knn

K = 12


@jax.jit
def of(points, mask=None):
    return normals.pca_normals(points, knn(points, points, mask, k=K))


@jax.jit
def sum_of_normals(points):
    return normals.pca_normals(points, knn(points, points, k=K)).normal.sum()


def sphere(num_points):
    points = np.random.default_rng(0).normal(size=(num_points, 3))
    return points / np.sqrt((points**2).sum(axis=1, keepdims=True))


def test_sphere_and_host_twin():
    points = sphere(512)
    found, twin = of(jnp.array(points, jnp.float32)), host.pca_normals(points.astype(np.float32), k=K)
    assert found.ok.all()
    np.testing.assert_allclose(np.abs(np.sum(found.normal * twin.normal, axis=1)), 1.0, atol=1e-4)
    np.testing.assert_allclose(found.curvature, twin.curvature, atol=1e-5)
    assert (1 - np.abs(np.sum(found.normal * points, axis=1))).mean() < 1e-2


def test_rotation_scale_and_offset(x64):
    points = sphere(64) * [1.0, 0.8, 0.5]
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    found, moved = of(jnp.array(points)), of(jnp.array(1e-4 * points @ rotation.T + 3.0))
    np.testing.assert_allclose(np.abs(np.sum(found.normal @ rotation.T * moved.normal, axis=1)), 1.0, atol=1e-6)
    np.testing.assert_allclose(found.curvature, moved.curvature, atol=1e-6)


def test_padding_does_not_count():
    points = jnp.array(sphere(64), jnp.float32)
    padded = jnp.concatenate([points, jnp.full((16, 3), 0.3)])
    alone, beside = of(points), of(padded, jnp.arange(80) < 64)
    np.testing.assert_allclose(alone.normal, beside.normal[:64], atol=2e-5)


def test_gradient_equals_finite_differences(x64):
    points = jnp.array(sphere(24) * [1.0, 0.8, 0.5])
    neighbors = jax.jit(knn, static_argnames="k")(points, points, k=K)
    weights = jnp.array(np.random.default_rng(2).normal(size=(24, 3)))

    @jax.jit
    def height(x):
        result = normals.pca_normals(x, neighbors)
        return jnp.sum(jnp.sum(result.normal * weights, axis=1) ** 2) + jnp.sum(result.curvature)

    step = jnp.array(np.random.default_rng(3).normal(size=(24, 3))) * 1e-5
    expected = (height(points + step) - height(points - step)) / 2
    np.testing.assert_allclose(jnp.sum(jax.jit(jax.grad(height))(points) * step), expected, rtol=1e-5)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((12, 3)),
        np.outer(np.arange(12), [1.0, 2.0, 2.0]),
        np.concatenate([np.eye(3), -np.eye(3), 2 * np.eye(3), -2 * np.eye(3)]),
        np.column_stack([np.indices((4, 3)).reshape(2, -1).T, np.zeros(12)]),
    ],
    ids=["one place", "line", "octahedron", "square grid"],
)
def test_degenerate_neighbourhoods(points):
    points = jnp.array(points, jnp.float32)
    found = of(points)
    assert np.isfinite(found.normal).all() and np.isfinite(found.curvature).all()
    assert np.isfinite(jax.jit(jax.grad(sum_of_normals))(points)).all()
    is_flat_patch = bool(jnp.all(points[:, 2] == 0)) and bool(jnp.any(points != 0))
    assert (found.ok == is_flat_patch).all()
