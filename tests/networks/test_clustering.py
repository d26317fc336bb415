"""Clusters of made-up embeddings: how many, which points, whatever the order, the padding and the capacity."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.networks import clustering
from jprimfit.networks.clustering import cluster

NUM_POINTS, NUM_CHANNELS = 600, 8
run = jax.jit(cluster, static_argnames="num_clusters")


def blobs(sizes, *, seed=0, spread=0.1, num_points=NUM_POINTS):
    """Shuffled points of clusters 4 apart, then padding that lies on the first cluster; labels, -1 = padding."""
    generator = np.random.default_rng(seed)
    labels = np.repeat(np.arange(len(sizes)), sizes)
    generator.shuffle(labels)
    corners = np.stack(np.unravel_index(generator.permutation(3**NUM_CHANNELS)[: len(sizes)], (3,) * NUM_CHANNELS), 1)
    embedding = 4.0 * corners[labels] + spread * generator.normal(size=(len(labels), NUM_CHANNELS))
    padding = num_points - len(labels)
    embedding = np.concatenate([embedding, np.repeat(4.0 * corners[:1], padding, axis=0)]).astype(np.float32)
    return embedding, np.concatenate([labels, np.full(padding, -1)])


def assert_found(membership, labels):
    """Every cluster has one column, and its points lie in no other."""
    membership = np.asarray(membership)
    valid = labels >= 0
    assert np.isfinite(membership).all() and not membership[~valid].any()
    np.testing.assert_allclose(membership[valid].sum(axis=1), 1, atol=1e-5)
    found = membership.argmax(axis=1)
    columns = {label: set(found[labels == label]) for label in np.unique(labels[valid])}
    assert all(len(column) == 1 for column in columns.values()), columns
    assert len(set.union(*columns.values())) == len(columns)
    used = membership[valid].max(axis=0) > 0
    assert used.sum() == len(columns)
    assert membership[valid].max(axis=1).min() > 0.99


@pytest.mark.parametrize(
    "sizes",
    [(600,), (300, 200, 95, 5), (10,) * 60, (575, 5, 5, 5, 5, 5), (30, 30)],
    ids=lambda s: f"{len(s)} of {s[0]}",
)
def test_clusters_are_found_with_their_number(sizes):
    embedding, labels = blobs(sizes)
    assert_found(run(embedding, labels >= 0), labels)


def test_wide_clusters_are_not_split():
    embedding, labels = blobs((200, 200, 200), spread=0.15)
    assert_found(run(embedding, labels >= 0), labels)


def test_more_points_than_are_looked_at():
    sizes = (3000, 1500, 470, 30)
    embedding, labels = blobs(sizes, num_points=5200)
    assert len(embedding) > 2 * clustering.NUM_SEEN
    assert_found(run(embedding, labels >= 0), labels)


def test_more_clusters_than_columns_keeps_the_dense_ones():
    embedding, labels = blobs((200, 150, 100, 80, 40, 30))
    membership = np.asarray(run(embedding, labels >= 0, num_clusters=4))
    assert membership.shape == (NUM_POINTS, 4)
    kept = labels < 4
    assert_found(membership[kept], labels[kept])
    np.testing.assert_allclose(membership.sum(axis=1), 1, atol=1e-5)


def test_the_order_of_the_points_is_nothing():
    embedding, labels = blobs((300, 200, 95, 5))
    order = np.random.default_rng(1).permutation(NUM_POINTS)
    one, other = run(embedding, labels >= 0), run(embedding[order], labels[order] >= 0)
    same = (np.asarray(one) @ np.asarray(one).T)[order][:, order]  # whether two points belong together
    np.testing.assert_allclose(np.asarray(other) @ np.asarray(other).T, same, atol=1e-4)


def test_what_padding_holds_is_nothing():
    embedding, labels = blobs((200, 100, 5))
    elsewhere = np.where((labels >= 0)[:, None], embedding, 7).astype(np.float32)
    np.testing.assert_array_equal(run(embedding, labels >= 0), run(elsewhere, labels >= 0))


@pytest.mark.parametrize("sizes", [(200, 100, 50, 20, 5), (1400, 900, 350, 50)], ids=["few", "more than are seen"])
def test_how_much_padding_there_is_is_nothing(sizes):
    answers = []
    for num_points in (sum(sizes), 3000, 8192):
        embedding, labels = blobs(sizes, num_points=num_points)
        membership = np.asarray(run(embedding, labels >= 0))
        assert_found(membership, labels)
        answers.append(membership[: sum(sizes)])
    for other in answers[1:]:
        np.testing.assert_allclose(other, answers[0], atol=1e-5)


@pytest.mark.parametrize("place", ["the end", "every ninth"])
def test_padding_may_lie_anywhere(place):
    embedding, labels = blobs((300, 200, 80, 20), num_points=5400)
    rows = np.arange(4800, 5400) if place == "the end" else 9 * np.arange(600) + 7
    moved, moved_labels = np.full_like(embedding, 7), np.full_like(labels, -1)
    moved[rows], moved_labels[rows] = embedding[:600], labels[:600]
    membership = np.asarray(run(moved, moved_labels >= 0))
    assert_found(membership, moved_labels)
    np.testing.assert_allclose(membership[rows], np.asarray(run(embedding, labels >= 0))[:600], atol=1e-5)


def test_a_full_cloud_is_looked_at_evenly():
    index, valid = clustering._evenly(jnp.asarray(8192), clustering.NUM_SEEN)
    np.testing.assert_array_equal(index, np.arange(0, 8192, 4))
    assert valid.all()
    index, valid = clustering._evenly(jnp.asarray(5), 8)
    np.testing.assert_array_equal(index[valid], np.arange(5))
    assert valid.sum() == 5


def test_single_points_of_a_small_cloud_are_no_clusters():
    embedding, labels = blobs((60, 1, 1, 1, 2), num_points=100)
    membership = np.asarray(run(embedding, labels >= 0))
    assert np.sum(membership.max(axis=0) > 0) == 1
    np.testing.assert_allclose(membership[labels >= 0].max(axis=1), 1)


@pytest.mark.parametrize("num_valid", [0, 1, 2, 5])
def test_few_points_or_none(num_valid):
    embedding, labels = blobs((num_valid,) if num_valid else (1,))
    mask = np.arange(NUM_POINTS) < num_valid
    membership = np.asarray(run(embedding, mask))
    assert np.isfinite(membership).all() and not membership[~mask].any()
    if num_valid > 1:
        assert_found(membership, labels)


def test_points_all_alone_belong_to_nothing_or_something_but_are_finite():
    embedding = 100 * np.random.default_rng(0).normal(size=(NUM_POINTS, NUM_CHANNELS)).astype(np.float32)
    membership = np.asarray(run(embedding, np.ones(NUM_POINTS, bool)))
    assert np.isfinite(membership).all() and membership.min() >= 0
    np.testing.assert_allclose(membership.sum(axis=1), np.round(membership.sum(axis=1)), atol=1e-5)
