"""Rotations are proper, agree with scipy, turn what they should, and random ones are uniform."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jprimfit.geometry import rigid

rotation_between = jax.jit(rigid.rotation_between)
derivative_of_rotation_between = jax.jit(jax.jacrev(rigid.rotation_between))


def unit(vector):
    return np.asarray(vector) / np.linalg.norm(vector)


def is_rotation(matrix, atol):
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=atol)
    np.testing.assert_allclose(np.linalg.det(matrix), 1, atol=atol)


def test_rotation_about_agrees_with_scipy(x64, tolerance):
    axis, angle = np.array([1.0, -2.0, 0.5]), 2.3
    expected = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix()
    rotation = rigid.rotation_about(jnp.array(axis), jnp.array(angle))
    np.testing.assert_allclose(rotation, expected, atol=tolerance["float64"])
    np.testing.assert_array_equal(rigid.rotation_about(jnp.zeros(3), jnp.array(1.0)), np.eye(3))


@pytest.mark.parametrize(
    "source, target",
    [((1, 0, 0), (0, 1, 0)), ((1, 2, 3), (-2, 0.1, 5)), ((0, 0, 2), (0, 0, 3)), ((1, 2, 3), (-1, -2, -3)),
     ((0, 0, 1), (1e-4, 0, -1)), ((0, 0, 1), (1e-2, 0, -1))],
)  # fmt: skip
def test_rotation_between_turns_source_into_target(source, target, tolerance):
    source, target = jnp.array(source, jnp.float32), jnp.array(target, jnp.float32)
    rotation = np.asarray(rotation_between(source, target))
    is_rotation(rotation, tolerance["float32"])
    np.testing.assert_allclose(rotation @ unit(source), unit(target), atol=1.1e-4)
    assert bool(jnp.all(jnp.isfinite(derivative_of_rotation_between(source, target))))


def test_rotation_between_is_exact_in_double_precision_and_the_least(x64, tolerance):
    source, target = jnp.array([1.0, 2.0, 3.0]), jnp.array([-2.0, 0.5, 1.0])
    rotation = rotation_between(source, target)
    is_rotation(np.asarray(rotation), tolerance["float64"])
    np.testing.assert_allclose(rotation @ source / 14**0.5, target / 5.25**0.5, atol=tolerance["float64"])
    cosine = source @ target / (14 * 5.25) ** 0.5
    np.testing.assert_allclose((jnp.trace(rotation) - 1) / 2, cosine, atol=tolerance["float64"])


def test_random_rotations_are_rotations_and_uniform(tolerance):
    keys = jax.random.split(jax.random.key(0), 4000)
    rotations = np.asarray(jax.jit(jax.vmap(rigid.random_rotation))(keys))
    products = np.einsum("nij,nkj->nik", rotations, rotations)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=tolerance["float32"])
    assert np.all(np.linalg.det(rotations) > 0)
    # Under the Haar measure every entry has mean 0 and variance 1/3, and the angle t has the mean (pi/2 + 2/pi).
    np.testing.assert_allclose(rotations.mean(axis=0), np.zeros((3, 3)), atol=0.04)
    np.testing.assert_allclose(rotations.var(axis=0), np.full((3, 3), 1 / 3), atol=0.02)
    angles = np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))
    np.testing.assert_allclose(angles.mean(), np.pi / 2 + 2 / np.pi, atol=0.04)


def test_random_rotation_takes_the_dtype(x64):
    assert rigid.random_rotation(jax.random.key(0), dtype=jnp.float64).dtype == jnp.float64
    assert rigid.random_rotation(jax.random.key(0)).dtype == jnp.float32


def test_apply_agrees_with_a_loop(tolerance):
    points = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    rotation = rigid.random_rotation(jax.random.key(1))
    translation = jnp.array([1.0, 2.0, 3.0])
    expected = [2.5 * np.asarray(rotation) @ p + np.asarray(translation) for p in points]
    moved = rigid.apply(jnp.array(points), rotation, translation, 2.5)
    np.testing.assert_allclose(moved, expected, atol=tolerance["float32"])
