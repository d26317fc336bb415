"""Adaptive-radius groups: reach, cap, padding, gathered features."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry import grouping

POINTS = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
CENTROIDS = POINTS[:5] + np.float32(0.01)
adaptive_groups = jax.jit(grouping.adaptive_groups, static_argnames=("k", "max_radius"))


@pytest.mark.parametrize("max_radius", [np.inf, 1.0, 0.012])
def test_groups_equal_a_loop(max_radius):
    groups = adaptive_groups(jnp.array(CENTROIDS), jnp.array(POINTS), k=6, max_radius=max_radius)
    index, sq_distance, mask, count = groups.neighbors
    for i, centroid in enumerate(CENTROIDS):
        distance = np.sqrt(((POINTS - centroid) ** 2).sum(axis=1))
        order = np.argsort(distance, kind="stable")[:6]
        kept = [j for j in order if distance[j] < max_radius]
        assert index[i, : len(kept)].tolist() == kept
        assert mask[i].tolist() == [True] * len(kept) + [False] * (6 - len(kept))
        assert count[i] == len(kept)
        assert (index[i, len(kept) :] == (kept[0] if kept else 0)).all()
        np.testing.assert_allclose(groups.radius[i], min(distance[order[-1]], max_radius), rtol=1e-6)
        if kept:
            np.testing.assert_allclose(sq_distance[i, len(kept) :], distance[kept[0]] ** 2, rtol=1e-5)


def test_radius_follows_the_density():
    spacing = np.concatenate([np.full(20, 0.01), np.full(20, 0.1)]).cumsum()
    points = jnp.array(np.column_stack([spacing, np.zeros((40, 2))]), jnp.float32)
    radius = adaptive_groups(points, points, k=5).radius
    np.testing.assert_allclose(radius[10] * 10, radius[30], rtol=1e-4)


def test_fewer_valid_points_than_k():
    mask = jnp.arange(20) < 3
    groups = adaptive_groups(jnp.array(CENTROIDS), jnp.array(POINTS), mask, k=6)
    assert (groups.neighbors.mask.sum(axis=1) == 3).all() and (groups.neighbors.index < 3).all()
    assert np.isfinite(groups.radius).all()
    none = adaptive_groups(jnp.array(CENTROIDS), jnp.array(POINTS), jnp.zeros(20, bool), k=6)
    assert not none.neighbors.mask.any() and (none.neighbors.index == 0).all() and (none.radius == 0).all()


def test_gather_and_relative_positions():
    groups = adaptive_groups(jnp.array(CENTROIDS), jnp.array(POINTS), k=6)
    index = groups.neighbors.index
    relative = grouping.relative_positions(jnp.array(CENTROIDS), jnp.array(POINTS), index)
    np.testing.assert_allclose((relative**2).sum(axis=-1), groups.neighbors.sq_distance, rtol=1e-5)
    features = jnp.arange(40.0).reshape(20, 2)
    gathered = grouping.gather(features, index)
    for i, row in enumerate(index.tolist()):
        np.testing.assert_array_equal(gathered[i], np.asarray(features)[row])
    # The derivative of a gather counts how often each row was taken.
    taken = jax.grad(lambda x: jnp.sum(grouping.gather(x, index)))(features)
    np.testing.assert_array_equal(taken[:, 0], np.bincount(np.asarray(index).ravel(), minlength=20))
