"""Inverse-distance interpolation: the formula, its limits, its derivative."""

import jax
import jax.numpy as jnp
import numpy as np

from jprimfit.geometry import interpolation

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(15, 3)).astype(np.float32)
QUERIES = RNG.normal(size=(6, 3)).astype(np.float32)
FEATURES = RNG.normal(size=(15, 4)).astype(np.float32)

weights_of = jax.jit(interpolation.inverse_distance, static_argnames="k")
interpolate = jax.jit(interpolation.interpolate)


def test_equals_a_loop():
    weights = weights_of(jnp.array(QUERIES), jnp.array(POINTS))
    result = interpolate(jnp.array(FEATURES), weights)
    for i, query in enumerate(QUERIES):
        sq = ((POINTS - query).astype(np.float64) ** 2).sum(axis=1)
        nearest = np.argsort(sq)[:3]
        weight = 1 / np.maximum(sq[nearest], 1e-10)
        np.testing.assert_array_equal(weights.index[i], nearest)
        np.testing.assert_allclose(result[i], weight @ FEATURES[nearest] / weight.sum(), atol=2e-6)


def test_constants_are_kept_and_points_give_their_own_feature():
    weights = weights_of(jnp.array(QUERIES), jnp.array(POINTS), k=5)
    np.testing.assert_allclose(weights.weight.sum(axis=1), 1.0, rtol=1e-6)
    constant = interpolate(jnp.full((15, 2), 3.0), weights)
    np.testing.assert_allclose(constant, 3.0, rtol=1e-6)
    at_points = weights_of(jnp.array(POINTS), jnp.array(POINTS))
    result = interpolate(jnp.array(FEATURES), at_points)
    np.testing.assert_allclose(result, FEATURES, atol=1e-6)


def test_padding_has_no_weight():
    weights = weights_of(jnp.array(QUERIES), jnp.array(POINTS), jnp.arange(15) == 7)
    result = interpolate(jnp.array(FEATURES), weights)
    np.testing.assert_allclose(result, np.broadcast_to(FEATURES[7], (6, 4)), rtol=1e-6)
    empty = weights_of(jnp.array(QUERIES), jnp.array(POINTS), jnp.zeros(15, bool))
    assert (empty.weight == 0).all() and (interpolate(jnp.array(FEATURES), empty) == 0).all()


def test_linear_in_the_features():
    weights = weights_of(jnp.array(QUERIES), jnp.array(POINTS))
    gradient = jax.grad(lambda x: interpolate(x, weights).sum())(jnp.array(FEATURES))
    expected = np.zeros(15)
    np.add.at(expected, np.asarray(weights.index).ravel(), np.asarray(weights.weight).ravel())
    np.testing.assert_allclose(gradient[:, 0], expected, atol=1e-6)
