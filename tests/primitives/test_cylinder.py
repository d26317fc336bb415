"""Cylinders: gauge, partial arcs, and the shapes that must not pass for one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.primitives import cylinder
from jprimfit.types import Cylinder

fit = jax.jit(cylinder.fit)


def arc(radius, half_width, num_points=300, seed=0):
    """Points and normals on a cylinder about z, height 0 to 4, within an angle of half_width from the x axis."""
    rng = np.random.default_rng(seed)
    turn, height = rng.uniform(-half_width, half_width, num_points), rng.uniform(0, 4, num_points)
    normals = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    return radius * normals + height[:, None] * np.array([0, 0, 1.0]), normals


def fitted(points, normals, dtype="float32"):
    return fit(*(jnp.asarray(a, dtype) for a in (points, np.ones(len(points)), normals)))


@pytest.mark.parametrize("radius, half_width", [(1, np.pi), (0.05, np.pi), (1, np.pi / 4), (20, 0.2)])
def test_center_is_the_axis_point_nearest_the_mean_for_any_arc_and_sign_of_normals(x64, radius, half_width):
    points, normals = arc(radius, half_width)
    normals = normals * np.random.default_rng(1).choice([-1, 1], (len(points), 1))
    found = fitted(points, normals, "float64")
    assert found.ok
    np.testing.assert_allclose(found.primitive.axis, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(found.primitive.center, [0, 0, points[:, 2].mean()], atol=1e-9)
    np.testing.assert_allclose(found.primitive.radius, radius, rtol=1e-9)


def test_shapes_that_are_no_cylinder_are_not_ok():
    rng = np.random.default_rng(0)
    flat = rng.uniform(-1, 1, (400, 3)) * np.array([1, 1, 0])
    up = np.array([0, 0, 1.0]) + 0.02 * rng.normal(size=(400, 3))
    assert not fitted(flat + 0.005 * rng.normal(size=(400, 3)), up / np.linalg.norm(up, axis=1, keepdims=True)).ok
    ball = rng.normal(size=(400, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    assert not fitted(ball, ball).ok
    points, normals = arc(1, 1e-3)
    assert not fitted(points, normals).ok


def test_signs_axis_and_gauge():
    primitive = Cylinder(jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 0.0]), jnp.array(2.0))
    points = jnp.array([[4.0, 0.0, 7.0], [1.0, 0.5, -3.0], [1.0, 0.0, 9.0]])
    np.testing.assert_allclose(cylinder.signed_distance(primitive, points), [1, -1.5, -2])
    np.testing.assert_allclose(cylinder.normal(primitive, points)[:2], [[1, 0, 0], [0, 1, 0]])
    on_axis = cylinder.normal(primitive, points)[2]
    np.testing.assert_allclose([on_axis @ on_axis, on_axis[2]], [1, 0], atol=1e-6)
    np.testing.assert_allclose(cylinder.project(primitive, points)[:2], [[3, 0, 7], [1, 2, -3]])
    half_turn = jnp.diag(jnp.array([1.0, -1.0, -1.0]))
    turned = cylinder.transform(primitive, half_turn, jnp.array([0.0, 1.0, 0.0]), 3.0)
    np.testing.assert_allclose(turned.axis, [0, 0, 1])
    np.testing.assert_allclose(jnp.append(turned.center, turned.radius), [3, 1, 0, 6])


def test_discrepancy_of_parallel_axes_is_their_distance():
    axis, radius = jnp.array([0.0, 0.6, 0.8]), jnp.array(1.0)
    a = Cylinder(axis, jnp.array([0.0, 0.0, 0.0]), radius)
    b = Cylinder(-axis, jnp.array([3.0, 6.0, 8.0]), radius + 0.25)
    np.testing.assert_allclose(cylinder.discrepancy(a, b), [0, 3, 0.25], atol=1e-6)
    crossed = Cylinder(jnp.array([0.0, 0.8, -0.6]), jnp.array([3.0, 0.0, 0.0]), radius)
    np.testing.assert_allclose(cylinder.discrepancy(a, crossed), [np.pi / 2, 3, 0], atol=1e-6)


def test_samples_fill_the_tube():
    primitive = Cylinder(jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 2.0, 3.0]), jnp.array(2.0))
    points = cylinder.sample(jax.random.key(0), primitive, num_points=4000, extent=1.5)
    points = np.asarray(points) - np.array([1, 2, 3])
    np.testing.assert_allclose(points.T @ points / 4000, np.diag([2, 2, 0.75]), atol=0.1)
    assert np.abs(points[:, 2]).max() <= 1.5
