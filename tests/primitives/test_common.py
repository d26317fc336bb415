"""Unit scale and back, and what "determined" promises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry.linalg import eigen_smallest, moments
from jprimfit.primitives import common

standardise = jax.jit(common.standardise)


def test_standardise_centres_scales_and_moves_back(x64):
    rng = np.random.default_rng(0)
    points, weights = 1e-3 * rng.normal(size=(20, 3)) + np.array([5.0, 0, 1]), rng.uniform(size=20)
    standard = standardise(jnp.asarray(points), jnp.asarray(weights))
    local, share = np.asarray(standard.local), np.asarray(standard.weights)
    np.testing.assert_allclose(share, weights / weights.sum(), rtol=1e-12)
    np.testing.assert_allclose(share @ local, 0, atol=1e-10)
    np.testing.assert_allclose(share @ np.sum(local**2, axis=1), 1, rtol=1e-10)
    np.testing.assert_allclose(np.asarray(standard.center) + float(standard.scale) * local, points, atol=1e-14)
    np.testing.assert_allclose(standard.count, weights.sum() ** 2 / np.sum(weights**2))


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_standardise_of_a_single_place_has_scale_one(weight):
    points = jnp.full((5, 3), 123.456, jnp.float32)
    standard = standardise(points, jnp.full(5, weight, jnp.float32))
    np.testing.assert_array_equal(standard.scale, 1)
    np.testing.assert_array_equal(standard.local * standard.weights[:, None], 0)


def test_standard_error_of_a_direction_is_that_of_repeated_draws(x64):
    rng = np.random.default_rng(1)
    deviations = np.array([1.0, 0.3, 0.1])
    clouds = jnp.asarray(rng.normal(size=(400, 100, 3)) * deviations)
    vectors = jax.jit(jax.vmap(lambda p: eigen_smallest(moments(p, jnp.ones(100)).covariance).vector))(clouds)
    error = np.std(np.asarray(vectors)[:, 1])
    values = np.sort(deviations**2)
    np.testing.assert_allclose(error, np.sqrt(values[0] * values[1] / 100) / (values[1] - values[0]), rtol=0.1)


def test_a_direction_is_determined_unless_it_is_chance():
    determined = jax.jit(common.direction_determined)
    for values, count, expected in [
        ((0.0, 1.0, 1.0), 3.0, True),
        ((0.0, 0.0, 1.0), 100.0, False),
        ((1.0, 1.0, 1.0), 1e6, False),
        ((0.9, 1.0, 1.0), 100.0, False),  # 0.95 rad of standard error
        ((0.9, 1.0, 1.0), 1e5, True),  # 0.03 rad
        ((-1e-9, 1.0, 1.0), 100.0, True),
        ((0.0, 0.0, 0.0), 0.0, False),
    ]:
        assert bool(determined(jnp.array(values), jnp.array(count))) == expected
