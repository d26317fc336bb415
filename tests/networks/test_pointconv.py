"""PointConv against loops that form every weight matrix W(k, c_in, c_out): values, gradients, masks, statistics."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.networks.layers import EPSILON, MOMENTUM
from jprimfit.networks.pointconv import PointConv, PointConvConfig
from jprimfit.types import Neighbors

NUM_CLOUDS, NUM_POINTS, NUM_CENTROIDS, NUM_NEIGHBORS = 2, 9, 5, 4
FORMS = {
    "grouped": PointConvConfig(weight_channels=3, grouped=True),
    "grouped, no density": PointConvConfig(weight_channels=3, grouped=True, density=False),
    "cheap": PointConvConfig(weight_channels=3, grouped=False),
    "cheap, normals": PointConvConfig(weight_channels=3, grouped=False, kernel="position+normals"),
}


class Inputs(NamedTuple):
    """What PointConv takes, of one cloud or of several."""

    centroids: np.ndarray
    centroid_normals: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    mask: np.ndarray
    features: np.ndarray
    density: np.ndarray
    groups: Neighbors


def toy_inputs(generator):
    """One cloud: a few neighbours missing, the last centroid without any, the last point padding."""
    index = np.stack([generator.permutation(NUM_POINTS - 1)[:NUM_NEIGHBORS] for _ in range(NUM_CENTROIDS)])
    mask = np.ones((NUM_CENTROIDS, NUM_NEIGHBORS), bool)
    mask[1, 2:] = mask[3, 3:] = mask[4] = False
    index = np.where(mask, index, index[:, :1]).astype(np.int32)
    points, centroids = generator.normal(size=(NUM_POINTS, 3)), generator.normal(size=(NUM_CENTROIDS, 3))
    normals, own = generator.normal(size=(NUM_POINTS, 3)), generator.normal(size=(NUM_CENTROIDS, 3))
    sq_distance = np.sum((points[index] - centroids[:, None]) ** 2, axis=2)
    return Inputs(
        centroids,
        own / np.sqrt(np.sum(own**2, axis=1, keepdims=True)),
        points,
        normals / np.sqrt(np.sum(normals**2, axis=1, keepdims=True)),
        np.arange(NUM_POINTS) < NUM_POINTS - 1,
        generator.normal(size=(NUM_POINTS, 4)),
        generator.uniform(0.5, 3, NUM_POINTS),
        Neighbors(index, sq_distance, mask, mask.sum(axis=1).astype(np.int32)),
    )


CLOUDS = jax.tree.map(lambda *x: np.stack(x), *[toy_inputs(np.random.default_rng(n)) for n in range(NUM_CLOUDS)])


def cast(tree, dtype):
    return jax.tree.map(lambda x: jnp.asarray(x, dtype if np.issubdtype(x.dtype, np.floating) else x.dtype), tree)


def layer(config):
    return PointConv(6, config, (5, 7))


@pytest.fixture(scope="module", params=FORMS)
def case(request, toy):
    config = FORMS[request.param]
    one = cast(jax.tree.map(lambda x: x[0], CLOUDS), np.float32)
    return config, toy.variables_of(layer(config), *one, train=False)


@partial(jax.jit, static_argnames=("config", "train"))
def convolve(variables, clouds, *, config, train):
    """All clouds, and the changed statistics in training."""
    mutable = ["batch_stats"] if train else False
    apply = partial(layer(config).apply, variables, train=train, mutable=mutable)
    return jax.vmap(lambda one: apply(*one), axis_name="cloud")(clouds)


# The reference: every function sees all clouds (b, ...), in float64.


def normalised(x, mask, variables, train, found):
    """BatchNorm; what the running statistics become is appended to `found`."""
    params, stats = variables
    mean, variance = stats["mean"], stats["variance"]
    if train:
        mean, variance = x[mask].mean(axis=0), x[mask].var(axis=0)
        found.append([MOMENTUM * stats["mean"] + (1 - MOMENTUM) * mean])
        found.append([MOMENTUM * stats["variance"] + (1 - MOMENTUM) * variance])
    return (x - mean) / np.sqrt(variance + EPSILON) * params["scale"] + params["shift"]


def pointwise(x, mask, variables, train, found):
    params, stats = variables
    for number in range(len(stats)):
        x = x @ params[f"Dense_{number}"]["kernel"]
        name = f"BatchNorm_{number}"
        x = np.maximum(normalised(x, mask, (params[name], stats[name]), train, found), 0)
    return x


def at_neighbors(values, groups):
    return np.stack([v[index] for v, index in zip(values, groups.index, strict=True)])


def scale_of(density, groups, params):
    """Inverse density over the largest in the neighbourhood, before the density net."""
    inverse = np.where(groups.mask, 1 / at_neighbors(density, groups), 0)
    return (inverse / np.maximum(inverse.max(axis=2, keepdims=True), 1e-300))[..., None]


def kernel_inputs(clouds, offset, config):
    """Loops over centroids and neighbours: offset in units of the group's radius, three angles free of sign."""
    rows = np.zeros((*clouds.groups.index.shape, 3 if config.kernel == "position" else 6))
    for b, i, j in np.ndindex(*clouds.groups.index.shape):
        radius = max(np.sqrt(clouds.groups.sq_distance[b, i]))
        d, own = offset[b, i, j] / radius, clouds.centroid_normals[b, i]
        other = clouds.normals[b, clouds.groups.index[b, i, j]]
        angles = [abs(d @ own), abs(d @ other), abs(own @ other)]
        rows[b, i, j] = d if config.kernel == "position" else [*d, *angles]
    return rows


def reference(variables, clouds, config, train):
    """Features of all centroids, and the new running statistics in the order in which they come."""
    params, stats, groups, found = variables["params"], variables["batch_stats"], clouds.groups, []

    def block(name):
        return params[name], stats[name]

    offset = at_neighbors(clouds.points, groups) - clouds.centroids[:, :, None]
    if config.grouped:
        grouped = np.concatenate([offset, at_neighbors(clouds.features, groups)], axis=-1)
        grouped = pointwise(grouped, groups.mask, block("mlp"), train, found)
        weights = pointwise(offset, groups.mask, block("weight_net"), train, found)
    else:
        grouped = at_neighbors(pointwise(clouds.features, clouds.mask, block("mlp"), train, found), groups)
        dense = params["weight_net"]
        weights = np.maximum(kernel_inputs(clouds, offset, config) @ dense["kernel"] + dense["bias"], 0)
    scale = np.ones((*groups.index.shape, 1))
    if config.density:
        scale = scale_of(clouds.density, groups, params)
        if config.grouped:
            scale = pointwise(scale, groups.mask, block("density_net"), train, found)
        else:
            scale = np.maximum(scale @ params["density_net"]["kernel"] + params["density_net"]["bias"], 0)
        dense = params["density_scale"]
        scale = 1 / (1 + np.exp(-(scale @ dense["kernel"] + dense["bias"])))
    out = np.zeros((*groups.index.shape[:2], 6))
    basis = params["kernel"]["kernel"].reshape(config.weight_channels, grouped.shape[-1], 6)  # H
    for b, i, j in np.ndindex(*groups.index.shape):
        if groups.mask[b, i, j]:
            matrix = sum(weights[b, i, j, v] * basis[v] for v in range(config.weight_channels))  # W(k), c_in by c_out
            share = 1 if config.grouped else max(groups.mask[b, i].sum(), 1)
            out[b, i] += scale[b, i, j, 0] * grouped[b, i, j] @ matrix / share
    return np.maximum(normalised(out, groups.mask.any(axis=2), block("norm"), train, found), 0), found


@pytest.mark.parametrize("train", [False, True])
def test_values_are_those_of_the_loop(case, train):
    config, variables = case
    found = convolve(variables, cast(CLOUDS, np.float32), config=config, train=train)
    expected, statistics = reference(cast64(variables), CLOUDS, config, train)
    if train:
        found, changed = found
        assert len(jax.tree.leaves(changed)) == len(statistics)
        ours = sorted(float(jnp.sum(leaf[row])) for leaf in jax.tree.leaves(changed) for row in range(NUM_CLOUDS))
        theirs = sorted(float(np.sum(leaf)) for leaf in statistics for _ in range(NUM_CLOUDS))
        np.testing.assert_allclose(ours, theirs, atol=1e-5)
    np.testing.assert_allclose(found, expected, atol=1e-5, rtol=1e-5)


def cast64(tree):
    return jax.tree.map(lambda x: np.asarray(x, np.float64), tree)


def moved(tree, direction, length):
    return jax.tree.map(lambda x, d: x + length * d, tree, direction)


def test_gradients_are_the_slopes_of_the_loop(case, x64):
    config, variables = case
    generator = np.random.default_rng(5)
    variables = cast64(variables)
    cotangent = generator.normal(size=(NUM_CLOUDS, NUM_CENTROIDS, 6))

    def score(params, free, out_of):
        clouds = CLOUDS._replace(features=free[0], points=free[1])
        return jnp.sum(cotangent * out_of({**variables, "params": params}, clouds))

    def layers(variables, clouds):
        found = convolve(variables, cast(clouds, np.float64), config=config, train=True)
        return found[0]

    free = (CLOUDS.features, CLOUDS.points)
    slopes = jax.grad(partial(score, out_of=layers), argnums=(0, 1))(variables["params"], free)
    for _ in range(3):
        along = jax.tree.map(lambda x: generator.normal(size=x.shape), (variables["params"], free))
        ends = [
            score(*moved((variables["params"], free), along, length), lambda v, c: reference(v, c, config, True)[0])
            for length in (1e-6, -1e-6)
        ]
        expected = (ends[0] - ends[1]) / 2e-6
        ours = sum(np.sum(s * d) for s, d in zip(jax.tree.leaves(slopes), jax.tree.leaves(along), strict=True))
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-4)


def test_the_order_of_neighbors_is_nothing(case):
    config, variables = case
    groups = CLOUDS.groups
    other = CLOUDS._replace(groups=Neighbors(*(f[:, :, ::-1] for f in groups[:3]), groups.count))
    one, other = (convolve(variables, cast(c, np.float32), config=config, train=False) for c in (CLOUDS, other))
    np.testing.assert_allclose(one, other, atol=1e-5)


@pytest.mark.parametrize("train", [False, True])
def test_what_padding_holds_is_nothing(case, train):
    config, variables = case
    mask = CLOUDS.mask
    groups = CLOUDS.groups
    other = CLOUDS._replace(
        features=np.where(mask[..., None], CLOUDS.features, 50),
        density=np.where(mask, CLOUDS.density, 1e-3),
        groups=groups._replace(index=np.where(groups.mask, groups.index, groups.index[:, :, :1])),
    )
    one, other = (convolve(variables, cast(c, np.float32), config=config, train=train) for c in (CLOUDS, other))
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_the_other_clouds_of_a_batch_do_not_enter_evaluation(case):
    config, variables = case
    other = jax.tree.map(lambda x: x.copy(), CLOUDS)
    other.points[1] *= 3
    other.features[1] += 7
    one, other = (convolve(variables, cast(c, np.float32), config=config, train=False) for c in (CLOUDS, other))
    np.testing.assert_array_equal(one[0], other[0])
    assert np.max(np.abs(one[1] - other[1])) > 0.1


def test_signs_of_normals_do_not_enter(case):
    config, variables = case
    other = CLOUDS._replace(normals=-CLOUDS.normals)
    one, other = (convolve(variables, cast(c, np.float32), config=config, train=False) for c in (CLOUDS, other))
    np.testing.assert_array_equal(one, other)


def test_points_on_top_of_each_other_have_finite_gradients(case):
    config, variables = case
    groups = CLOUDS.groups._replace(sq_distance=np.zeros_like(CLOUDS.groups.sq_distance))
    flat = CLOUDS._replace(points=0 * CLOUDS.points, centroids=0 * CLOUDS.centroids, density=0 * CLOUDS.density)
    clouds = cast(flat._replace(groups=groups), np.float32)

    def score(params, points):
        variables_ = {**variables, "params": params}
        return jnp.sum(convolve(variables_, clouds._replace(points=points), config=config, train=True)[0])

    slopes = jax.grad(score, argnums=(0, 1))(variables["params"], clouds.points)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))
