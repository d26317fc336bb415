"""The hierarchy of a cloud: every level against the single operations, both ways of building it, masks."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry import density, grouping, hierarchy, host, interpolation
from jprimfit.geometry.neighbors import knn
from jprimfit.geometry.sampling import farthest_points

SPEC = hierarchy.HierarchySpec(
    num_points=(24, 8, 4),
    encoder_neighbors=(8, 6, 5),
    decoder_neighbors=(5, 4, 9),
    density_neighbors=(12, 4, 4),
    density_radius=(0.5, 1.0, 2.0),
    density_variance=(0.05, 0.1, 0.2),
    max_radius=(np.inf, 0.8, np.inf),
)
CLOUD = np.random.default_rng(0).normal(size=(64, 3)).astype(np.float32)
build = jax.jit(hierarchy.build, static_argnames="spec")


def assert_same(found, expected, atol=1e-5):
    found_leaves, expected_leaves = jax.tree.leaves(found), jax.tree.leaves(expected)
    assert len(found_leaves) == len(expected_leaves)
    for a, b in zip(found_leaves, expected_leaves, strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype
        np.testing.assert_allclose(a, b, atol=atol, rtol=1e-5)


@jax.jit
def step_by_step(points):
    """The hierarchy by one search per index set, each on its own."""
    levels, index, encoder, decoder, densities, weights = [points], [], [], [], [], []
    for step, num in enumerate(SPEC.num_points):
        points, cap = levels[-1], SPEC.max_radius[step]
        index.append(farthest_points(points, num_samples=num))
        coarse = points[index[-1]]
        k = SPEC.encoder_neighbors[step]
        encoder.append(grouping.adaptive_groups(coarse, points, k=k, max_radius=cap).neighbors)
        k = SPEC.decoder_neighbors[step]
        decoder.append(grouping.adaptive_groups(points, points, k=k, max_radius=cap).neighbors)
        around = knn(points, points, k=SPEC.density_neighbors[step])
        radius, variance = SPEC.density_radius[step], SPEC.density_variance[step]
        densities.append(density.gaussian_density(around, variance=variance, radius=radius))
        weights.append(interpolation.inverse_distance(points, coarse))
        levels.append(coarse)
    masks = [jnp.ones(len(level), bool) for level in levels]
    return hierarchy.Hierarchy(*map(tuple, (levels, masks, index, encoder, decoder, densities, weights)))


def test_every_level_equals_the_single_operations():
    assert_same(build(CLOUD, spec=SPEC), step_by_step(CLOUD))


def test_host_gives_the_same():
    on_host = host.build_hierarchy(CLOUD, spec=SPEC)
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(on_host))
    assert_same(on_host, build(CLOUD, spec=SPEC))
    mask = np.arange(64) < 40
    assert_same(host.build_hierarchy(CLOUD, mask, spec=SPEC), build(CLOUD, mask, spec=SPEC))


def test_host_gives_the_same_where_distances_tie():
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3).astype(np.float32)
    assert_same(host.build_hierarchy(grid, spec=SPEC), build(grid, spec=SPEC))


def test_padding_changes_nothing():
    mask = np.arange(64) < 40
    elsewhere = np.where(mask[:, None], CLOUD, CLOUD[0] + 0.01)
    one, other = build(CLOUD, mask, spec=SPEC), build(elsewhere, mask, spec=SPEC)
    assert_same(one.index, other.index)
    assert_same(one.encoder_groups, other.encoder_groups)
    for step in range(SPEC.num_steps):
        valid = np.asarray(one.mask[step])
        assert np.asarray(one.encoder_groups[step].index).max() < valid.sum()
        np.testing.assert_array_equal(one.density[step][valid], other.density[step][valid])


@pytest.mark.parametrize("num_valid", [0, 1, 10])
def test_fewer_points_than_a_level(num_valid):
    built = build(CLOUD, np.arange(64) < num_valid, spec=SPEC)
    for num, mask in zip((64, *SPEC.num_points), built.mask, strict=True):
        assert mask.tolist() == [i < num_valid for i in range(num)]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(built))
    assert len(set(np.asarray(built.index[0])[:num_valid].tolist())) == num_valid


def test_duplicates_count_once():
    built = build(np.repeat(CLOUD[:5], [13, 13, 13, 13, 12], axis=0), spec=SPEC)
    assert [int(mask.sum()) for mask in built.mask] == [64, 5, 5, 4]


def test_index_sets_do_not_change_under_rotation():
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0].astype(np.float32)
    one, other = build(CLOUD, spec=SPEC), build(CLOUD @ rotation, spec=SPEC)
    assert_same(one._replace(points=other.points), other, atol=1e-4)


NO_GROUPS = replace(SPEC, decoder_neighbors=(0, 4, 0))
restored = jax.jit(hierarchy.from_index_sets)


@pytest.mark.parametrize("num_valid", [64, 40, 10, 2, 1])
@pytest.mark.parametrize("spec", [SPEC, NO_GROUPS], ids=["groups", "no groups"])
def test_index_sets_are_all_there_is_to_store(spec, num_valid):
    mask = np.arange(64) < num_valid
    on_host = host.build_hierarchy(CLOUD, mask, spec=spec)
    sets = hierarchy.index_sets(on_host)
    indices = [leaf for name, field in sets._asdict().items() for leaf in field if name.endswith("index")]
    assert all(leaf.dtype == np.uint16 for leaf in indices)
    found = restored(CLOUD, sets, mask)
    # Of groups the number before the cap is not stored: beyond k nobody needs it.
    groups = [tuple(g._replace(count=g.mask.sum(axis=1).astype(np.int32)) for g in part) for part in on_host[3:5]]
    assert_same(found, on_host._replace(encoder_groups=groups[0], decoder_groups=groups[1]))


def test_index_sets_of_no_points_give_no_neighbor():
    mask = np.zeros(64, bool)
    found = restored(CLOUD, hierarchy.index_sets(host.build_hierarchy(CLOUD, mask, spec=SPEC)), mask)
    groups = (*found.encoder_groups, *found.decoder_groups)
    assert not any(leaf.any() for leaf in (*found.mask, *(g.mask for g in groups), *(g.count for g in groups)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


@pytest.mark.parametrize("num_valid", [64, 10])
def test_index_sets_serve_the_turned_cloud(num_valid):
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0].astype(np.float32)
    mask, turned = np.arange(64) < num_valid, CLOUD @ rotation
    sets = hierarchy.index_sets(host.build_hierarchy(CLOUD, mask, spec=SPEC))
    expected = host.build_hierarchy(turned, mask, spec=SPEC)
    for one, other in zip(sets[:-1], hierarchy.index_sets(expected)[:-1], strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, other)
    found = restored(turned, sets, mask)
    for name in ("points", "mask", "index", "density", "interpolation"):
        assert_same(getattr(found, name), getattr(expected, name), atol=1e-4)


def test_many_points_and_wide_groups_are_stored_in_wider_numbers():
    built = host.build_hierarchy(CLOUD, spec=SPEC)
    wide = np.zeros((64, 300), bool)
    groups = built.decoder_groups[0]._replace(mask=wide)
    far = np.zeros((1 << 16 | 1, 3), np.float32)
    sets = hierarchy.index_sets(
        built._replace(points=(far, *built.points[1:]), decoder_groups=(groups, *built.decoder_groups[1:]))
    )
    assert sets.index[0].dtype == np.int32 and sets.decoder_count[0].dtype == np.int32
    assert sets.encoder_count[0].dtype == np.uint8


def test_vmap_equals_one_by_one_and_compiles_once():
    clouds = np.stack([CLOUD, CLOUD[::-1] * 0.5])
    traced = []
    batched = jax.jit(jax.vmap(lambda cloud: traced.append(1) or hierarchy.build(cloud, spec=SPEC)))
    both = batched(clouds)
    batched(clouds + 1)
    assert len(traced) == 1
    for row, cloud in enumerate(clouds):
        assert_same(jax.tree.map(lambda leaf, row=row: leaf[row], both), build(cloud, spec=SPEC))


def test_spec_is_checked_and_hashable():
    assert hash(hierarchy.HierarchySpec()) == hash(hierarchy.HierarchySpec())
    with pytest.raises(ValueError, match="one value per step"):
        hierarchy.HierarchySpec(num_points=(8, 4))
    with pytest.raises(ValueError, match="must not increase"):
        hierarchy.HierarchySpec(num_points=(8, 16, 4, 2))
