"""The closed form of a plane is the general estimate, its covariance included."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.fitting import planes
from jprimfit.primitives.estimation import estimate


def plate(num_points, seed=0):
    """Points of a tilted plate with noise, uneven weights; their weighted mean is 0."""
    rng = np.random.default_rng(seed)
    flat = np.stack([rng.uniform(-2, 3, num_points), rng.uniform(-1, 1, num_points), 0.2 * rng.normal(size=num_points)])
    points, weights = (np.linalg.qr(rng.normal(size=(3, 3)))[0] @ flat).T, rng.uniform(0.2, 1, num_points)
    return points - np.average(points, axis=0, weights=weights), weights


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_estimate_by_iteration(x64, seed):
    points, weights = plate(64, seed)
    found = planes.fit(points, weights)
    general = jax.jit(estimate)(jax.tree.map(jnp.asarray, found.primitive), jnp.asarray(points), jnp.asarray(weights))
    assert found.ok and general.ok
    np.testing.assert_allclose(general.primitive.normal, found.primitive.normal, atol=1e-12)
    np.testing.assert_allclose(general.primitive.offset, found.primitive.offset, atol=1e-12)
    np.testing.assert_allclose(general.sigma, found.sigma, rtol=1e-9)
    np.testing.assert_allclose(
        general.covariance, found.covariance, rtol=0.05, atol=0.01 * np.abs(found.covariance).max()
    )


def test_a_line_has_a_plane_but_not_a_sure_one(x64):
    points, weights = np.outer(np.linspace(-1, 1, 30), [1.0, 2.0, 2.0]) / 3, np.ones(30)
    found = planes.fit(points, weights)
    assert not found.ok and found.sigma < 1e-12
    assert np.all(np.isfinite(found.covariance))
