"""The whole network: every backbone with every head, what may not change its answer, and where training differs."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry.hierarchy import HierarchySpec, from_index_sets
from jprimfit.geometry.preparation import prepare
from jprimfit.networks.pointconv import PointConvConfig
from jprimfit.networks.pointnet2 import PointNet2Config
from jprimfit.networks.segmenter import Segmenter, SegmenterConfig, SegmentTypes

INF = float("inf")
NUM_POINTS = 40
SPEC = HierarchySpec((12, 5), (6, 4), (0, 4), (6, 4), (0.5, 1.0), (0.1, 0.2), (INF, INF))
EVERY = HierarchySpec((12, 5), (6, 4), (5, 4), (6, 4), (0.5, 1.0), (0.1, 0.2), (INF, INF))  # decoder groups everywhere
CHEAP = SegmenterConfig(
    hierarchy=SPEC,
    pointconv=PointConvConfig(
        stem=(6,),
        encoder=((8,), (8, 8)),
        decoder=((8,), (8, 8)),
        weight_channels=4,
        grouped=False,
        kernel="position+normals",
    ),
    num_points=NUM_POINTS,
    features=("xyz", "pca"),
    neighborhoods=(6, 9),
    head="prototype",
    embedding_size=4,
    shared=8,
    normals="pca",
)
PUBLISHED = SegmenterConfig(
    hierarchy=EVERY,
    pointconv=PointConvConfig(encoder=((6, 8), (8, 8)), decoder=((8, 8, 8), (8, 8)), weight_channels=4),
    num_points=NUM_POINTS,
    neighborhoods=(6, 9),
    num_slots=5,
    shared=8,
    dropout=0.5,
    types="pooled",
)
NEIGHBORS = replace(
    CHEAP,
    hierarchy=EVERY,
    pointconv=replace(CHEAP.pointconv, decoder=((8, 8, 8), (8, 8))),
    normals="neighbors",
)
POINTNET2 = PointNet2Config(encoder=((6, 8), (8, 8)), decoder=((8, 8), (8,)))
CONFIGS = {
    "cheap PointConv, prototype": CHEAP,
    "cheap PointConv, PointConv's order": replace(
        CHEAP, hierarchy=EVERY, pointconv=replace(CHEAP.pointconv, order="pointconv", decoder=((8, 8), (8, 8)))
    ),
    "cheap PointConv, normals of neighbours": NEIGHBORS,
    "PointConv, slots, pooled": PUBLISHED,
    "PointNet++, slots": replace(PUBLISHED, backbone="pointnet2", pointnet2=POINTNET2, hierarchy=SPEC, types="point"),
    "cheap PointNet++, prototype, pooled": replace(
        CHEAP, backbone="pointnet2", pointnet2=replace(POINTNET2, grouped=False), types="pooled"
    ),
    "PointNet++ on all points": replace(
        PUBLISHED,
        backbone="pointnet2",
        pointnet2=POINTNET2,
        hierarchy=HierarchySpec((12, 1), (6, 12), (0, 0), (6, 4), (0.5, 1.0), (0.1, 0.2), (0.8, INF)),
    ),
}
SEGMENTS = np.random.default_rng(9).dirichlet(np.ones(3), NUM_POINTS).astype(np.float32)


@pytest.fixture(scope="module", params=CONFIGS)
def case(request, toy):
    config = CONFIGS[request.param]
    return config, toy.segmenter_variables(config), SEGMENTS if config.types == "pooled" else None


def prepared_cloud(toy, config, num_valid=NUM_POINTS, num_points=NUM_POINTS, seed=0):
    return toy.cloud(num_valid, num_points, seed=seed, spec=config.hierarchy)


def test_shapes_and_ranges(case, toy):
    config, variables, segments = case
    found = toy.answer(variables, prepared_cloud(toy, config), None, segments, config=config)
    assert found.type_logits.shape == (NUM_POINTS, 4) and found.features.shape == (NUM_POINTS, 8)
    np.testing.assert_allclose(np.sum(np.square(found.normals), axis=1), 1, atol=1e-5)
    instances = found.membership_logits if config.head == "slots" else found.embedding
    assert instances.shape == (NUM_POINTS, 5 if config.head == "slots" else 4)
    assert (found.membership_logits is None) != (found.embedding is None)
    assert (found.segment_type_logits is None) == (segments is None)
    if segments is not None:
        assert found.segment_type_logits.shape == (3, 4)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    assert np.std(instances, axis=0).max() > 1e-3  # points are told apart


def test_queries_are_rows_of_the_full_answer(case, toy):
    config, variables, segments = case
    query = np.array([7, 0, 39, 7, 20], np.int32)
    full = toy.answer(variables, prepared_cloud(toy, config), None, segments, config=config)
    some = toy.answer(
        variables, prepared_cloud(toy, config), query, None if segments is None else segments[query], config=config
    )
    for name in ("normals", "type_logits", "features", "membership_logits", "embedding"):
        one, other = getattr(full, name), getattr(some, name)
        if one is not None:
            np.testing.assert_allclose(other, one[query], atol=1e-5, rtol=1e-5, err_msg=name)


def test_what_padding_holds_is_nothing(case, toy):
    config, variables, segments = case
    valid = np.arange(NUM_POINTS) < 31
    segments = None if segments is None else segments * valid[:, None]
    prepared = prepared_cloud(toy, config, num_valid=31)
    elsewhere = prepared._replace(
        points=np.where(valid[:, None], prepared.points, 3),
        local_normals=np.where(valid[:, None, None], prepared.local_normals, prepared.local_normals[:1, ::-1]),
        curvature=np.where(valid[:, None], prepared.curvature, 0.3),
    )
    one, other = (toy.answer(variables, c, None, segments, config=config) for c in (prepared, elsewhere))
    for name in one._fields:
        a, b = getattr(one, name), getattr(other, name)
        if a is not None:
            rows = slice(None) if name == "segment_type_logits" else slice(0, 31)
            np.testing.assert_allclose(a[rows], b[rows], atol=1e-6, err_msg=name)


def test_training_counts_no_padding_at_any_level(case, toy):
    """Nine points on levels made for more: a copy of a point must not weigh twice in any statistic."""
    config, variables, _ = case
    config = replace(config, dropout=0.0, types="point")
    spec = config.hierarchy
    if spec.num_points[1] == 1:
        spec = replace(spec, encoder_neighbors=(6, 9))
    config = replace(config, hierarchy=spec)
    exact = replace(config, hierarchy=replace(spec, num_points=(9, spec.num_points[1])))
    padded = prepared_cloud(toy, config, 9, 20)
    bare = prepared_cloud(toy, exact, 9, 9)
    found, statistics = toy.answer(variables, padded, config=config, train=True)
    expected, expected_statistics = toy.answer(variables, bare, config=exact, train=True)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5, rtol=1e-4), statistics, expected_statistics)
    np.testing.assert_allclose(found.type_logits[:9], expected.type_logits, atol=2e-4, rtol=1e-3)


@pytest.mark.parametrize("config", [CHEAP, NEIGHBORS, PUBLISHED], ids=["cheap", "neighbours", "published"])
def test_the_order_of_the_points_is_nothing(config, toy):
    """But for the first point, with which the samples begin."""
    variables = toy.segmenter_variables(config)
    order = np.concatenate([[0], 1 + np.random.default_rng(3).permutation(NUM_POINTS - 1)])
    points = np.asarray(prepared_cloud(toy, config).points)
    one = toy.answer(variables, prepared_of(points, config), config=config)
    other = toy.answer(variables, prepared_of(points[order], config), config=config)
    signs = np.sign(np.sum(one.normals[order] * other.normals, axis=1, keepdims=True))  # PCA's are of either sign
    np.testing.assert_allclose(other.normals * signs, one.normals[order], atol=1e-4)
    for a, b in zip((one.features, one.type_logits), (other.features, other.type_logits), strict=True):
        np.testing.assert_allclose(b, a[order], atol=1e-4, rtol=1e-4)


def prepared_of(points, config):
    return prepare(points, spec=config.hierarchy, neighborhoods=config.neighborhoods, workers=1)


@pytest.mark.parametrize("config", [CHEAP, NEIGHBORS], ids=["cheap", "neighbours"])
def test_signs_of_pca_normals_turn_the_normals_and_nothing_else(config, toy):
    variables, prepared = toy.segmenter_variables(config), prepared_cloud(toy, config)
    signs = np.random.default_rng(2).choice([-1, 1], (NUM_POINTS, 2, 1)).astype(np.float32)
    one = toy.answer(variables, prepared, config=config)
    other = toy.answer(variables, prepared._replace(local_normals=prepared.local_normals * signs), config=config)
    np.testing.assert_allclose(other.normals, one.normals * signs[:, 0], atol=1e-6)
    for name in ("features", "embedding", "type_logits"):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name), atol=1e-6, err_msg=name)


def test_normals_begin_as_the_mean_of_pca(toy):
    prepared = prepared_cloud(toy, CHEAP)
    variables = jax.tree.map(jnp.asarray, toy.segmenter_variables(CHEAP))
    for name in ("normal_weight", "normal_turn"):
        variables["params"][name] = jax.tree.map(jnp.zeros_like, variables["params"][name])
    found = toy.answer(variables, prepared, config=CHEAP).normals
    first, second = prepared.local_normals[:, 0], prepared.local_normals[:, 1]
    mean = first + np.sum(first * second, axis=1, keepdims=True) * second
    np.testing.assert_allclose(found, mean / np.sqrt(np.sum(mean**2, axis=1, keepdims=True)), atol=1e-5)


def test_real_initial_values_begin_there_too(toy):
    prepared = prepared_cloud(toy, CHEAP)

    @jax.jit
    def initial(prepared):
        hierarchy = from_index_sets(prepared.points, prepared.sets, prepared.mask)
        inputs = (prepared.points, hierarchy, prepared.local_normals, prepared.curvature)
        variables = Segmenter(CHEAP).init(jax.random.key(0), *inputs)
        return Segmenter(CHEAP).apply(variables, *inputs).normals

    first, second = prepared.local_normals[:, 0], prepared.local_normals[:, 1]
    mean = first + np.sum(first * second, axis=1, keepdims=True) * second
    mean /= np.sqrt(np.sum(mean**2, axis=1, keepdims=True))
    assert np.min(np.sum(initial(prepared) * mean, axis=1)) > 0.99


def test_dropout_only_in_training_and_by_its_key(toy):
    config = replace(PUBLISHED, types="point")
    variables, prepared = toy.segmenter_variables(config), prepared_cloud(toy, config)

    @jax.jit
    def train(key):
        def one(prepared):
            hierarchy = from_index_sets(prepared.points, prepared.sets, prepared.mask)
            inputs = (prepared.points, hierarchy, prepared.local_normals, prepared.curvature)
            return Segmenter(config).apply(
                variables, *inputs, train=True, rngs={"dropout": key}, mutable=["batch_stats"]
            )[0]

        return jax.vmap(one, axis_name="cloud")(jax.tree.map(lambda x: x[None], prepared)).features[0]

    one, same, other = train(jax.random.key(0)), train(jax.random.key(0)), train(jax.random.key(1))
    np.testing.assert_array_equal(one, same)
    assert np.mean(one != other) > 0.2
    kept = np.asarray(toy.answer(variables, prepared, config=config).features) > 0
    assert np.mean(kept) > 0.3 and np.mean(np.asarray(one) == 0) > np.mean(~kept)


def test_gradients_are_finite_and_reach_every_parameter(case, toy):
    config, variables, segments = case
    config = replace(config, dropout=0.0)
    segments = None if segments is None else jnp.asarray(segments)
    clouds = jax.tree.map(lambda *x: np.stack(x), *[prepared_cloud(toy, config, n, seed=n) for n in (1, 3, 40)])

    @jax.jit
    @jax.grad
    def slope(params):
        def one(prepared):
            hierarchy = from_index_sets(prepared.points, prepared.sets, prepared.mask)
            inputs = (prepared.points, hierarchy, prepared.local_normals, prepared.curvature)
            options = {"train": True, "segments": segments, "mutable": ["batch_stats"]}
            return Segmenter(config).apply({**variables, "params": params}, *inputs, **options)[0]

        found = jax.vmap(one, axis_name="cloud")(clouds)
        return sum(jnp.sum(jnp.sin(leaf + 0.1)) for leaf in jax.tree.leaves(found))

    for path, leaf in jax.tree_util.tree_leaves_with_path(slope(variables["params"])):
        assert np.isfinite(leaf).all() and np.any(np.asarray(leaf) != 0), jax.tree_util.keystr(path)


def test_segment_types_pool_the_largest_features_by_loops(toy):
    features = jnp.asarray(np.random.default_rng(0).uniform(size=(9, 5)), jnp.float32)
    membership = jnp.asarray(np.random.default_rng(1).dirichlet(np.ones(3), 9), jnp.float32)
    module = SegmentTypes()
    variables = toy.variables_of(module, features, membership)
    pooled = np.zeros((3, 5))
    for s, c in np.ndindex(3, 5):
        pooled[s, c] = max(features[n, c] * membership[n, s] for n in range(9))
    hidden, types = variables["params"]["hidden"], variables["params"]["types"]
    expected = np.maximum(pooled @ hidden["kernel"] + hidden["bias"], 0) @ types["kernel"] + types["bias"]
    found = module.apply(variables, features, membership)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_normals_of_neighbours_need_groups():
    with pytest.raises(ValueError, match="decoder_neighbors of at least 1"):
        replace(CHEAP, normals="neighbors")
