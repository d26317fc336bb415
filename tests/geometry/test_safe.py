"""Values against NumPy, and finite derivatives where the plain functions have none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry import safe


def finite(tree):
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


def test_values_agree_with_numpy():
    x = jnp.array([[3.0, 4.0, 0.0], [1.0, -2.0, 2.0]])
    np.testing.assert_allclose(safe.norm(x), np.linalg.norm(x, axis=1), rtol=1e-6)
    np.testing.assert_allclose(safe.norm(x, axis=0, keepdims=True), np.linalg.norm(x, axis=0, keepdims=True), rtol=1e-6)
    np.testing.assert_allclose(safe.unit(x), np.asarray(x) / np.linalg.norm(x, axis=1, keepdims=True), rtol=1e-6)
    np.testing.assert_allclose(safe.sqrt(jnp.array([4.0, 0.0, -1.0])), [2, 0, 0])
    np.testing.assert_allclose(safe.divide(jnp.array([4.0, 1.0]), jnp.array([2.0, 0.0])), [2, 0])
    np.testing.assert_allclose(safe.divide(x, jnp.array([[2.0], [0.0]])), [[1.5, 2, 0], [0, 0, 0]])


def test_arccos_is_exact_at_the_ends_and_beyond():
    np.testing.assert_allclose(safe.arccos(jnp.array([1.0, 1.1, -1.0, 0.5])), [0, 0, np.pi, np.pi / 3], rtol=1e-6)


@pytest.mark.parametrize(
    "function, at",
    [
        (safe.sqrt, jnp.array([0.0, -1.0, 1e-40, 1e-38])),
        (safe.norm, jnp.zeros((2, 3))),
        (safe.norm, jnp.full((1, 3), 1e-20)),
        (safe.unit, jnp.zeros((2, 3))),
        (safe.unit, jnp.full((1, 3), 1e-18)),
        (safe.arccos, jnp.array([1.0, -1.0, 2.0, 0.0])),
        (lambda x: safe.divide(jnp.ones_like(x), x), jnp.array([0.0, 1e-30, 2e-19])),
        (lambda x: safe.arctan2(x, 0 * x), jnp.array([0.0, 1.0])),
        (lambda x: safe.angle(x, x), jnp.array([1.0, 2.0, 3.0])),
        (lambda x: safe.line_angle(x, 0 * x), jnp.array([1.0, 2.0, 3.0])),
        (lambda x: safe.unit_or(x, jnp.array([0.0, 0.0, 1.0])), jnp.zeros((1, 3))),
    ],
)
def test_values_and_derivatives_are_finite(function, at):
    assert finite(jax.jit(lambda x: (function(x), jax.jacfwd(function)(x), jax.jacrev(function)(x)))(at))


def test_derivatives_agree_with_the_plain_functions():
    x = jnp.array([0.3, -0.4, 0.7])
    pairs = [(safe.norm, jnp.linalg.norm), (safe.unit, lambda v: v / jnp.linalg.norm(v)), (safe.arccos, jnp.arccos)]
    for ours, plain in pairs:
        np.testing.assert_allclose(jax.jit(jax.jacrev(ours))(x), jax.jit(jax.jacrev(plain))(x), rtol=1e-5, atol=1e-6)


def test_angles_keep_their_digits_at_zero_and_pi(tolerance):
    a = jnp.array([1.0, 2.0, -0.5])
    assert safe.angle(a, 3 * a) < tolerance["float32"]
    np.testing.assert_allclose(safe.angle(a, -a), np.pi, rtol=1e-6)
    assert safe.line_angle(a, -a) < tolerance["float32"]
    small = 1e-5  # its cosine is 1 in float32
    x, y = jnp.array([1.0, 0, 0]), jnp.array([jnp.cos(small), jnp.sin(small), 0])
    np.testing.assert_allclose([safe.angle(x, y), safe.line_angle(x, -y)], small, rtol=1e-5)


def test_unit_or_takes_the_fallback_at_zero():
    rows = jnp.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    np.testing.assert_allclose(safe.unit_or(rows, jnp.array([1.0, 0.0, 0.0])), [[1, 0, 0], [0, 1, 0]])
