"""Kernel density: PointConv's formula, its ball, and what the network takes of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry import density
from jprimfit.geometry.neighbors import knn

POINTS = np.random.default_rng(0).random((60, 3)).astype(np.float32)
search = jax.jit(knn, static_argnames="k")
gaussian_density = jax.jit(density.gaussian_density, static_argnames=("variance", "radius"))
relative = jax.jit(density.relative_inverse_density)


@pytest.mark.parametrize("radius", [np.inf, 0.3])
def test_equals_a_loop(radius):
    neighbors = search(jnp.array(POINTS), jnp.array(POINTS), k=60)
    found = gaussian_density(neighbors, variance=0.05, radius=radius)
    for i, point in enumerate(POINTS.astype(np.float64)):
        sq = ((POINTS - point) ** 2).sum(axis=1)
        inside = sq < radius**2
        pdf = np.exp(-sq[inside] / (2 * 0.05)) / (0.05**1.5 * (2 * np.pi) ** 1.5)
        np.testing.assert_allclose(found[i], pdf.mean(), rtol=1e-5)


def test_one_point_has_the_peak_of_the_kernel():
    neighbors = search(jnp.zeros((1, 3)), jnp.zeros((1, 3)), k=4)
    np.testing.assert_allclose(gaussian_density(neighbors, variance=0.5), (np.pi) ** -1.5, rtol=1e-6)


def test_crowded_points_are_denser():
    crowd = np.concatenate([POINTS * 0.1, POINTS + 2.0])
    neighbors = search(jnp.array(crowd), jnp.array(crowd), k=16)
    found = np.asarray(gaussian_density(neighbors, variance=0.05))
    assert found[:60].min() > found[60:].max()


def test_relative_inverse_density():
    queries = jnp.array(POINTS[:10])
    own = gaussian_density(search(jnp.array(POINTS), jnp.array(POINTS), k=60), variance=0.05)
    groups = search(queries, jnp.array(POINTS), jnp.arange(60) < 5, k=8)
    found = relative(own, groups)
    inverse = 1 / np.asarray(own)[np.asarray(groups.index)]
    np.testing.assert_allclose(found[:, :5], inverse[:, :5] / inverse[:, :5].max(axis=1, keepdims=True), rtol=1e-5)
    assert (found[:, 5:] == 0).all() and (found.max(axis=1) == 1).all()
    np.testing.assert_allclose(relative(own * 7.0, groups), found, rtol=1e-5)


def test_without_neighbours_all_is_zero():
    none = search(jnp.array(POINTS[:3]), jnp.array(POINTS), jnp.zeros(60, bool), k=4)
    zero = gaussian_density(none, variance=0.05)
    assert (zero == 0).all() and (density.inverse_density(zero) == 0).all()
    assert (relative(zero, none._replace(index=jnp.zeros((3, 4), jnp.int32))) == 0).all()
