"""Planes against NumPy's svd, closed forms and the extent of samples."""

import jax
import jax.numpy as jnp
import numpy as np

from jprimfit.primitives import plane
from jprimfit.types import Plane

fit = jax.jit(plane.fit)


def test_fit_is_the_smallest_singular_direction_of_the_weighted_centred_points(x64):
    rng = np.random.default_rng(0)
    points, weights = rng.normal(size=(30, 3)) * np.array([2, 1, 0.1]) + 5, rng.uniform(size=30)
    mean = weights @ points / weights.sum()
    normal = np.linalg.svd((points - mean) * np.sqrt(weights)[:, None])[2][2]
    normal *= np.sign(normal[np.argmax(np.abs(normal))])
    found = fit(*(jnp.asarray(a) for a in (points, weights, points)))
    np.testing.assert_allclose(found.primitive.normal, normal, atol=1e-12)
    np.testing.assert_allclose(found.primitive.offset, normal @ mean, atol=1e-12)
    assert found.ok


def test_a_blob_and_a_thin_strip_are_not_ok():
    rng = np.random.default_rng(0)
    ones = jnp.ones(200)
    for spread, expected in [((1, 1, 1), False), ((1, 1, 0.5), True), ((1, 0.02, 0), True), ((1, 1e-3, 0), False)]:
        points = jnp.asarray(rng.normal(size=(200, 3)) * np.array(spread), jnp.float32)
        assert bool(fit(points, ones, points).ok) == expected


def test_three_points_are_a_plane():
    points = jnp.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    found = fit(points, jnp.ones(3), points)
    np.testing.assert_allclose(found.primitive.normal, np.full(3, 3**-0.5), atol=1e-6)
    np.testing.assert_allclose(found.primitive.offset, 3**-0.5, atol=1e-6)
    assert found.ok


def test_signs_and_gauge():
    primitive = Plane(jnp.array([0.0, 0.0, 1.0]), jnp.array(2.0))
    points = jnp.array([[5.0, 6.0, 3.0], [0.0, 0.0, 0.5]])
    np.testing.assert_allclose(plane.signed_distance(primitive, points), [1, -1.5])
    half_turn = jnp.diag(jnp.array([1.0, -1.0, -1.0]))
    turned = plane.transform(primitive, half_turn, jnp.array([0.0, 0.0, 1.0]), 3.0)
    np.testing.assert_allclose(turned.normal, [0, 0, 1])
    np.testing.assert_allclose(turned.offset, -5)
    tilted = Plane(jnp.array([0.0, -0.6, -0.8]), jnp.array(-1.5))
    discrepancy = plane.discrepancy(primitive, tilted)
    np.testing.assert_allclose(discrepancy, [np.arccos(0.8), 0.5, 0], rtol=1e-6)


def test_samples_fill_the_square():
    primitive = Plane(jnp.array([0.0, 0.6, 0.8]), jnp.array(2.0))
    points = plane.sample(jax.random.key(0), primitive, num_points=4000, extent=0.5)
    offset = np.asarray(points) - np.array([0, 1.2, 1.6])
    np.testing.assert_allclose(offset.mean(axis=0), 0, atol=0.02)
    np.testing.assert_allclose(np.trace(offset.T @ offset) / 4000, 2 / 12, rtol=0.05)
    assert np.linalg.norm(offset, axis=1).max() < 0.5 * 2**0.5 + 1e-6
