"""Neighbourhoods against a loop over all pairs: order, ties, masks, padding, chunks."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jprimfit.geometry import neighbors

RULES = {
    "knn": neighbors.knn,
    "ball": partial(neighbors.ball, radius=0.9),
    "ball_nearest": partial(neighbors.ball_nearest, radius=0.9),
}


def loop(rule, queries, points, valid, *, k, radius=0.9):
    """The definition, query by query: candidates sorted by (distance, index), or by index alone for the ball."""
    rows = []
    for i, query in enumerate(np.asarray(queries)):
        limit = np.inf if rule == "knn" else np.broadcast_to(radius, len(queries))[i]
        sq = [float(np.sum((np.asarray(p, np.float64) - query) ** 2)) for p in points]
        hits = [(sq[j], j) for j in range(len(points)) if valid[j] and sq[j] < limit**2]
        hits = (sorted(hits, key=lambda hit: hit[1]) if rule == "ball" else sorted(hits))[:k]
        count = sum(bool(valid[j]) and sq[j] < limit**2 for j in range(len(points)))
        first = hits[0] if hits else (0.0, 0)
        padded = hits + [first] * (k - len(hits))
        rows.append(([j for _, j in padded], [d for d, _ in padded], [s < len(hits) for s in range(k)], count))
    return [np.array(column) for column in zip(*rows, strict=True)]


def check(rule, result, queries, points, valid, *, k, radius=0.9):
    index, sq_distance, mask, count = loop(rule, queries, points, valid, k=k, radius=radius)
    np.testing.assert_array_equal(result.index, index)
    np.testing.assert_array_equal(result.mask, mask)
    np.testing.assert_array_equal(result.count, count)
    np.testing.assert_allclose(result.sq_distance, sq_distance, rtol=1e-5, atol=1e-7)
    assert result.index.dtype == result.count.dtype == jnp.int32


@pytest.fixture(scope="module")
def cloud():
    return jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (300, 3)).astype(np.float32))


@pytest.fixture(scope="module")
def grid():
    """Whole-number positions, each several times: every distance is exact and ties with many others."""
    return jnp.asarray(np.random.default_rng(1).integers(0, 4, (300, 3)).astype(np.float32))


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("k", [3, 40])  # 300 points: k = 3 goes through two rounds of top_k, k = 40 through one
def test_agrees_with_a_loop(rule, k, cloud):
    valid = np.random.default_rng(2).random(300) < 0.8
    result = jax.jit(partial(RULES[rule], k=k))(cloud[:20], cloud, jnp.asarray(valid))
    check(rule, result, cloud[:20], cloud, valid, k=k)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("k", [3, 40])
def test_ties_go_to_the_lowest_index(rule, k, grid):
    search = neighbors.knn if rule == "knn" else partial(getattr(neighbors, rule), radius=2.0)
    result = jax.jit(partial(search, k=k))(grid[:40], grid)
    check(rule, result, grid[:40], grid, np.ones(300, bool), k=k, radius=2.0)


@pytest.mark.parametrize("rule", RULES)
def test_more_neighbours_than_points_leave_padding(rule, cloud):
    points = cloud[:5]
    check(rule, RULES[rule](cloud[5:9], points, k=8), cloud[5:9], points, np.ones(5, bool), k=8)


@pytest.mark.parametrize("rule", RULES)
def test_nothing_to_find_is_padding_of_zeros(rule, cloud):
    none = jnp.zeros(5, bool)
    for result in (RULES[rule](cloud[:4], cloud[:5], none, k=3), RULES[rule](cloud[:4], cloud[:0], k=3)):
        assert not result.mask.any()
        for value in (result.index, result.sq_distance, result.count):
            np.testing.assert_array_equal(value, jnp.zeros_like(value))


def test_a_radius_per_query_and_the_sphere_itself_is_outside():
    points = jnp.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    radius = jnp.array([1.0, 2.5, 3.5])
    queries = jnp.zeros((3, 3))
    for rule in ("ball", "ball_nearest"):
        result = getattr(neighbors, rule)(queries, points, radius=radius, k=2)
        np.testing.assert_array_equal(result.count, [1, 3, 4])
        check(rule, result, queries, points, np.ones(4, bool), k=2, radius=np.asarray(radius))


@pytest.mark.parametrize("chunk", [1, 7, 64])
def test_chunks_change_nothing(chunk, cloud):
    whole = jax.jit(partial(neighbors.knn, k=5))(cloud[:20], cloud)
    chex.assert_trees_all_equal(jax.jit(partial(neighbors.knn, k=5, chunk=chunk))(cloud[:20], cloud), whole)


def test_a_distance_has_the_same_bits_in_programs_of_every_shape():
    x, y, z, point = np.random.default_rng(7).uniform(-1, 1, (4, 5000)).astype(np.float32)
    distances = jax.jit(neighbors.sq_distances)
    whole = distances(jnp.asarray(x), jnp.asarray(y), jnp.asarray(z), jnp.asarray(point[:3]))
    for size in (1, 3, 15, 32, 300, 4096):
        part = distances(jnp.asarray(x[:size]), jnp.asarray(y[:size]), jnp.asarray(z[:size]), jnp.asarray(point[:3]))
        np.testing.assert_array_equal(part, whole[:size])


def test_under_vmap_a_cloud_does_not_see_the_others(cloud, grid):
    batched = jax.jit(jax.vmap(partial(neighbors.knn, k=5)))
    alone = jax.jit(partial(neighbors.knn, k=5))(cloud[:20], cloud)
    for other in (grid, grid * jnp.inf):
        both = batched(jnp.stack([cloud[:20], other[:20]]), jnp.stack([cloud, other]))
        chex.assert_trees_all_equal(jax.tree.map(lambda leaf: leaf[0], both), alone)


def test_one_trace_serves_two_clouds(cloud, grid):
    chex.clear_trace_counter()
    search = jax.jit(chex.assert_max_traces(lambda q, p: neighbors.ball(q, p, radius=1.0, k=4), n=1))
    search(cloud[:10], cloud)
    search(grid[:10], grid)


def test_permuted_points_give_the_same_neighbours(cloud):
    order = np.random.default_rng(3).permutation(300)
    one, other = neighbors.knn(cloud, cloud, k=4), neighbors.knn(cloud, cloud[order], k=4)
    np.testing.assert_array_equal(order[np.asarray(other.index)], one.index)


def test_small_distances_survive_far_from_the_origin():
    # In |q|^2 - 2qp + |p|^2 the squares are 3e4 and float32 leaves nothing of distances of 1e-3.
    steps = jnp.arange(8) / 1024
    points = jnp.stack([100 + steps, jnp.full(8, 100.0), jnp.full(8, 100.0)], axis=1)
    result = neighbors.knn(points[:1], points, k=8)
    np.testing.assert_array_equal(result.index[0], np.arange(8))
    np.testing.assert_array_equal(result.sq_distance[0], steps**2)


def test_double_precision_is_kept(x64, cloud):
    points = jnp.asarray(np.asarray(cloud, np.float64)) + 1e6
    result = neighbors.knn(points[:4], points, k=3)
    assert result.sq_distance.dtype == jnp.float64
    check("knn", result, points[:4], points, np.ones(300, bool), k=3)


def test_derivatives_are_zero_not_missing(cloud):
    gradient = jax.grad(lambda p: neighbors.ball_nearest(p[:4], p, radius=0.9, k=3).sq_distance.sum())(cloud)
    np.testing.assert_array_equal(gradient, jnp.zeros_like(cloud))


def test_top_k_prefers_the_lowest_index():
    """What the searches rely on, here and on accelerators."""
    ties = jnp.asarray(np.random.default_rng(4).integers(0, 3, (16, 2048)).astype(np.float32))
    expected = np.argsort(-np.asarray(ties), axis=1, kind="stable")[:, :32]
    np.testing.assert_array_equal(lax.top_k(ties, 32)[1], expected)


def test_no_neighbours_asked_for_is_refused(cloud):
    with pytest.raises(ValueError, match="give k >= 1"):
        neighbors.knn(cloud, cloud, k=0)
