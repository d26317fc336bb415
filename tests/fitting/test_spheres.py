"""The equations of a sphere written out give what the general ones give."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.fitting import segments, spheres
from jprimfit.primitives import estimation
from jprimfit.types import Sphere

general = jax.jit(estimation.estimate)


def cap(half_angle, noise, num=512, seed=0):
    """A segment at unit scale: part of a sphere seen from above, with weights."""
    generator = np.random.default_rng(seed)
    height = generator.uniform(np.cos(half_angle), 1, num)
    angle, width = generator.uniform(0, 2 * np.pi, num), np.sqrt(1 - height**2)
    points = np.stack([width * np.cos(angle), width * np.sin(angle), height], axis=1)
    points = 3.0 * points + 3.0 * noise * generator.normal(size=points.shape)
    return segments.segment(points, generator.uniform(0.5, 1.0, num)), generator


@pytest.mark.parametrize(
    ("half_angle", "noise"), [(np.pi, 0.0), (np.pi, 0.05), (np.pi, 0.3), (1.0, 0.05), (0.5, 0.1), (0.2, 1e-3)]
)
def test_the_same_as_the_general_equations(x64, half_angle, noise):
    given, generator = cap(half_angle, noise)
    start = Sphere(*(np.asarray(field) for field in _near_truth(given, generator)))
    expected = general(jax.tree.map(jnp.asarray, start), given.local, given.weights)
    found = spheres.estimate(start, given.local, given.weights)
    assert bool(found.ok) == bool(expected.ok) and found.num_iterations == expected.num_iterations
    np.testing.assert_allclose(found.primitive.center, expected.primitive.center, atol=1e-9)
    np.testing.assert_allclose(found.primitive.radius, expected.primitive.radius, atol=1e-9)
    np.testing.assert_allclose(found.sigma, expected.sigma, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-6, atol=1e-18)


def _near_truth(given, generator):
    center = -given.anchor / given.size + 0.02 * generator.normal(size=3)
    return center, np.float64(3.0 / given.size + 0.02)


def test_samples_first_and_the_same_in_the_end():
    given, generator = cap(1.2, 0.05, num=20_000)
    start = Sphere(*_near_truth(given, generator))
    found = spheres.estimate(start, given.local, given.weights)
    again = spheres.estimate(found.primitive, given.local, given.weights)
    assert found.ok and again.ok
    errors = np.sqrt(np.diagonal(found.covariance))
    assert np.max(np.abs(found.primitive.center - again.primitive.center) / errors[:3]) < 2 * estimation.CONVERGED
    assert abs(float(found.sigma) * given.size / 0.15 - 1) < 0.03


def test_a_plane_is_no_sphere():
    points = np.random.default_rng(0).normal(size=(300, 3)) * [1.0, 1.0, 0.0]
    given = segments.segment(points)
    found = spheres.estimate(Sphere(np.array([0.0, 0.0, 5.0]), np.float64(5.0)), given.local, given.weights)
    assert not found.ok and np.isfinite(found.covariance).all()
