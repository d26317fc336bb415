"""Spheres against NumPy's lstsq and the known bias of the algebraic fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.primitives import sphere
from jprimfit.types import Sphere

fit = jax.jit(sphere.fit)


def directions(num_points, seed=0):
    vectors = np.random.default_rng(seed).normal(size=(num_points, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def fitted(points, weights=None, dtype="float64"):
    weights = np.ones(len(points)) if weights is None else weights
    return fit(*(jnp.asarray(a, dtype) for a in (points, weights, points)))


def test_fit_is_the_weighted_algebraic_least_squares(x64):
    rng = np.random.default_rng(0)
    points = np.array([1.0, 2, 3]) + 2 * directions(40) + 0.1 * rng.normal(size=(40, 3))
    weights = rng.uniform(size=40)
    # |p|^2 = 2 c·p + (r^2 - |c|^2), linear in c and the bracket
    rows = np.concatenate([2 * points, np.ones((40, 1))], axis=1) * np.sqrt(weights)[:, None]
    solution = np.linalg.lstsq(rows, np.sum(points**2, axis=1) * np.sqrt(weights), rcond=None)[0]
    found = fitted(points, weights)
    np.testing.assert_allclose(found.primitive.center, solution[:3], atol=1e-10)
    np.testing.assert_allclose(found.primitive.radius, np.sqrt(solution[3] + solution[:3] @ solution[:3]), atol=1e-10)
    assert found.ok


def test_noise_widens_the_radius_as_documented(x64):
    noise = np.random.default_rng(1).normal(size=(20000, 3))
    found = fitted(directions(20000) + 0.15 * noise)
    np.testing.assert_allclose(found.primitive.radius, np.sqrt(1 + 3 * 0.15**2), rtol=3e-3)


@pytest.mark.parametrize("num_points, expected", [(4, True), (3, False)])
def test_four_points_are_a_sphere_and_three_are_not(num_points, expected):
    points = np.array([1.0, 0, 0]) + directions(num_points)
    found = fitted(points, dtype="float32")
    assert bool(found.ok) == expected
    if expected:
        np.testing.assert_allclose(found.primitive.center, [1, 0, 0], atol=1e-4)


@pytest.mark.parametrize("cap, expected", [(0.3, True), (0.02, False)])
def test_a_cap_is_ok_until_noise_hides_its_curvature(cap, expected):
    turned = directions(400) * np.array([cap, cap, 0])
    turned[:, 2] = np.sqrt(1 - np.sum(turned**2, axis=1))
    found = fitted(turned + 1e-3 * np.random.default_rng(2).normal(size=turned.shape), dtype="float32")
    assert bool(found.ok) == expected


def test_where_the_points_do_not_tell_the_mean_and_its_rms_distance_stand_in():
    square = np.array([[1.0, 1, 5], [1, -1, 5], [-1, 1, 5], [-1, -1, 5]])
    found = fitted(square, dtype="float32")
    assert not found.ok
    np.testing.assert_allclose(found.primitive.center, [0, 0, 5], atol=1e-6)
    np.testing.assert_allclose(found.primitive.radius, 2**0.5, rtol=1e-6)


def test_signs_and_the_center():
    primitive = Sphere(jnp.array([1.0, 0.0, 0.0]), jnp.array(2.0))
    points = jnp.array([[4.0, 0.0, 0.0], [1.0, 0.0, 0.5], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(sphere.signed_distance(primitive, points), [1, -1.5, -2])
    np.testing.assert_allclose(sphere.normal(primitive, points), [[1, 0, 0], [0, 0, 1], [0, 0, 1]])
    np.testing.assert_allclose(sphere.project(primitive, points), [[3, 0, 0], [1, 0, 2], [1, 0, 2]])
    discrepancy = sphere.discrepancy(primitive, Sphere(jnp.array([1.0, 3.0, 4.0]), jnp.array(1.5)))
    np.testing.assert_allclose(discrepancy, [0, 5, 0.5])


def test_samples_are_spread_evenly():
    primitive = Sphere(jnp.array([1.0, 0.0, 0.0]), jnp.array(2.0))
    points = np.asarray(sphere.sample(jax.random.key(0), primitive, num_points=4000, extent=0.1)) - np.array([1, 0, 0])
    np.testing.assert_allclose(points.T @ points / 4000, np.eye(3) * 4 / 3, atol=0.1)
