"""Cones: the paper's distance, signs, partial patches, and the shapes that must not pass for one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.primitives import cone
from jprimfit.types import Cone

fit = jax.jit(cone.fit)


def patch(half_angle, half_width, near, far, num_points=300, seed=0):
    """Points and outward normals on a cone with its apex at the origin about z, between two slant distances."""
    rng = np.random.default_rng(seed)
    turn, along = rng.uniform(-half_width, half_width, num_points), rng.uniform(near, far, num_points)
    around = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    up = np.array([0, 0, 1.0])
    points = along[:, None] * (np.cos(half_angle) * up + np.sin(half_angle) * around)
    return points, np.cos(half_angle) * around - np.sin(half_angle) * up


def fitted(points, normals, dtype="float32"):
    return fit(*(jnp.asarray(a, dtype) for a in (points, np.ones(len(points)), normals)))


@pytest.mark.parametrize(
    "half_angle, half_width, near, far",
    [(0.5, np.pi, 0, 1), (0.1, np.pi, 2, 3), (1.4, np.pi, 1, 2), (0.6, 0.5, 1, 2), (1.2, 0.3, 1, 2)],
)
@pytest.mark.parametrize("turn", [1, -1, 0])
def test_any_patch_with_normals_of_any_sign(x64, half_angle, half_width, near, far, turn):
    points, normals = patch(half_angle, half_width, near, far)
    signs = np.random.default_rng(1).choice([-1, 1], (len(points), 1)) if turn == 0 else turn
    found = fitted(points + 5, signs * normals, "float64")
    assert found.ok
    np.testing.assert_allclose(found.primitive.axis, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(found.primitive.apex, [5, 5, 5], atol=1e-9)
    np.testing.assert_allclose(found.primitive.half_angle, half_angle, atol=1e-9)


def test_the_axis_points_from_the_apex_to_the_points(x64):
    points, normals = patch(0.5, np.pi, 1, 2)
    turned = fitted(-points, -normals, "float64")
    np.testing.assert_allclose(turned.primitive.axis, [0, 0, -1], atol=1e-9)


def test_distance_is_the_papers_formula(x64):
    primitive = Cone(jnp.array([0.0, 0.6, 0.8]), jnp.array([1.0, 2.0, 3.0]), jnp.array(0.7))
    points = 2 * np.random.default_rng(0).normal(size=(200, 3)) + np.asarray(primitive.apex)
    offset = points - np.asarray(primitive.apex)
    length = np.linalg.norm(offset, axis=1)
    angle = np.arccos(offset @ np.asarray(primitive.axis) / length)
    expected = length * np.sin(np.minimum(np.abs(angle - 0.7), np.pi / 2))
    signed = cone.signed_distance(primitive, jnp.asarray(points))
    np.testing.assert_allclose(cone.distance(primitive, jnp.asarray(points)), expected, atol=1e-12)
    np.testing.assert_array_equal(np.asarray(signed) > 0, angle > 0.7)
    assert np.any(angle > 0.7 + np.pi / 2) and np.any(angle < 0.7)


def test_behind_the_apex_on_the_axis_and_at_the_apex():
    primitive = Cone(jnp.array([0.0, 0.0, 1.0]), jnp.array([0.0, 0.0, 1.0]), jnp.array(np.pi / 6))
    points = jnp.array([[0.0, 0.0, -1.0], [0.0, 0.0, 3.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(cone.signed_distance(primitive, points), [2, -1, 0], atol=1e-6)
    np.testing.assert_allclose(cone.normal(primitive, points)[::2], [[0, 0, -1], [0, 0, -1]], atol=1e-6)
    np.testing.assert_allclose(jnp.linalg.norm(cone.normal(primitive, points), axis=1), 1, atol=1e-6)
    feet = cone.project(primitive, points)
    np.testing.assert_allclose(feet[::2], [[0, 0, 1], [0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(jnp.linalg.norm(points - feet, axis=1), [2, 1, 0], atol=1e-6)


def test_shapes_that_are_no_cone_are_not_ok():
    rng = np.random.default_rng(0)
    jitter = 0.02 * rng.normal(size=(1000, 3))

    def ok(points, normals):
        normals = normals + jitter
        return bool(fitted(points, normals / np.linalg.norm(normals, axis=1, keepdims=True)).ok)

    turn, height = rng.uniform(0, 2 * np.pi, 1000), rng.uniform(-1, 1, 1000)
    around = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    up = np.broadcast_to([0.0, 0.0, 1.0], (1000, 3))
    assert not ok(around + height[:, None] * up, around)
    assert not ok(rng.uniform(-1, 1, (1000, 3)) * np.array([1, 1, 0]), up)
    ball = rng.normal(size=(1000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    assert not ok(ball, ball)
    points, normals = patch(0.5, np.pi, 0, 1, num_points=1000)
    assert ok(points, normals)


def test_discrepancy_tells_nappes_apart():
    axis, apex = jnp.array([0.0, 0.6, 0.8]), jnp.array([1.0, 2.0, 3.0])
    a, b = Cone(axis, apex, jnp.array(0.5)), Cone(-axis, apex + 2 * axis, jnp.array(0.75))
    np.testing.assert_allclose(cone.discrepancy(a, b), [np.pi, 2, 0.25], rtol=1e-6)


def test_samples_are_even_by_area():
    primitive = Cone(jnp.array([0.0, 0.0, 1.0]), jnp.array([0.0, 0.0, 1.0]), jnp.array(0.5))
    points = cone.sample(jax.random.key(0), primitive, num_points=4000, extent=2.0)
    height = np.asarray(points)[:, 2] - 1
    assert height.min() >= 0 and height.max() <= 2
    np.testing.assert_allclose(np.mean(height < 1), 0.25, atol=0.02)


def test_a_half_angle_past_a_right_one_is_the_cone_about_the_opposite_axis():
    primitive = Cone(jnp.array([0.0, 0.6, 0.8]), jnp.array([1.0, 2.0, 3.0]), jnp.array(1.8))
    folded = cone.canonical(primitive, jnp.zeros(3))
    np.testing.assert_allclose(folded.half_angle, np.pi - 1.8, rtol=1e-6)
    points = jax.random.normal(jax.random.key(0), (50, 3)) * 4
    np.testing.assert_allclose(cone.distance(folded, points), cone.distance(primitive, points), atol=2e-6)
    np.testing.assert_array_equal(cone.canonical(folded, jnp.zeros(3)).axis, folded.axis)
