"""A prepared cloud holds what the single searches give, whatever its padding."""

import jax
import numpy as np
import pytest

from jprimfit.geometry import host
from jprimfit.geometry.filtering import bilateral_normals
from jprimfit.geometry.hierarchy import HierarchySpec, index_sets
from jprimfit.geometry.preparation import layout, prepare

SPEC = HierarchySpec((32, 8), (8, 8), (0, 4), (8, 8), (0.5, 1.0), (0.25, 0.5), (0.9, np.inf))
CLOUD = host.normalize(np.random.default_rng(0).normal(size=(100, 3)) * [1.0, 1.0, 0.2])[0]


@pytest.mark.parametrize("neighborhoods", [(4, 20), (6,), ()])
def test_one_search_gives_what_separate_ones_do(neighborhoods, assert_trees_equal):
    prepared = prepare(CLOUD, spec=SPEC, neighborhoods=neighborhoods)
    assert_trees_equal(prepared.sets, index_sets(host.build_hierarchy(CLOUD, spec=SPEC)))
    assert prepared.mask.all() and prepared.local_normals.shape == (100, len(neighborhoods), 3)
    for column, k in enumerate(neighborhoods):
        expected = host.pca_normals(CLOUD, k=k)
        np.testing.assert_allclose(prepared.curvature[:, column], expected.curvature, atol=1e-6)
        agreement = np.abs(np.sum(prepared.local_normals[:, column] * expected.normal, axis=1))
        np.testing.assert_allclose(agreement, 1.0, atol=1e-5)


def test_filtered_normals_are_of_the_smallest_over_the_largest():
    prepared = prepare(CLOUD, spec=SPEC, neighborhoods=(0, 6, 20), num_points=130)
    surface = host.pca_normals(CLOUD, k=6)
    normal, curvature = surface.normal.astype(np.float32), surface.curvature.astype(np.float32)
    expected = bilateral_normals(CLOUD, normal, curvature, host.knn(CLOUD, CLOUD, k=20))
    agreement = np.abs(np.sum(prepared.local_normals[:100, 0] * expected.normal, axis=1))
    np.testing.assert_allclose(agreement, 1.0, atol=1e-5)
    np.testing.assert_allclose(prepared.curvature[:100, 0], expected.curvature, atol=1e-5)


def test_padding_repeats_the_first_point_and_changes_nothing():
    bare, padded = (prepare(CLOUD, spec=SPEC, neighborhoods=(8,), num_points=size) for size in (100, 130))
    assert padded.mask.sum() == 100 and padded.mask[:100].all()
    for name in ("points", "local_normals", "curvature"):
        found, expected = getattr(padded, name), getattr(bare, name)
        np.testing.assert_array_equal(found[:100], expected)
        np.testing.assert_array_equal(found[100:], np.repeat(expected[:1], 30, axis=0))
    for found, expected in zip(jax.tree.leaves(padded.sets), jax.tree.leaves(bare.sets), strict=True):
        np.testing.assert_array_equal(found[: len(expected)], expected)


@pytest.mark.parametrize("neighborhoods", [(0, 4, 20), ()])
def test_the_layout_is_that_of_what_is_prepared(neighborhoods):
    prepared = prepare(CLOUD, spec=SPEC, neighborhoods=neighborhoods, num_points=130)
    expected = layout(spec=SPEC, neighborhoods=neighborhoods, num_points=130)
    assert jax.tree.structure(prepared) == jax.tree.structure(expected)
    found = [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(prepared)]
    assert found == [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(expected)]


def test_a_point_alone():
    prepared = prepare(np.zeros((1, 3)), spec=SPEC, neighborhoods=(8,), num_points=10)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(prepared))
    assert prepared.mask.tolist() == [True] + [False] * 9


def test_what_cannot_be_prepared_is_named():
    with pytest.raises(ValueError, match="100 points, expected 1 to 50"):
        prepare(CLOUD, spec=SPEC, neighborhoods=(8,), num_points=50)
    with pytest.raises(ValueError, match="0 points"):
        prepare(CLOUD[:0], spec=SPEC, neighborhoods=(8,), num_points=50)
    with pytest.raises(ValueError, match="at least 3"):
        prepare(CLOUD, spec=SPEC, neighborhoods=(8, 2))


@pytest.fixture
def assert_trees_equal():
    def check(found, expected):
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(a, b)

    return check
