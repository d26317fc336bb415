"""Set abstraction against loops over centroids, neighbours and channels: values, gradients, masks, group-all."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.networks.layers import EPSILON
from jprimfit.networks.pointnet2 import SetAbstraction
from jprimfit.types import Neighbors

NUM_POINTS, WIDTHS = 8, (5, 6)


class Inputs(NamedTuple):
    """What SetAbstraction takes, of one cloud or of several."""

    centroids: np.ndarray
    points: np.ndarray
    mask: np.ndarray
    features: np.ndarray
    groups: Neighbors


def toy_inputs(generator, num_centroids):
    """One cloud: some neighbours missing, the last of several centroids without any."""
    k = NUM_POINTS if num_centroids == 1 else 3
    index = np.stack([generator.permutation(NUM_POINTS)[:k] for _ in range(num_centroids)])
    mask = np.ones(index.shape, bool)
    if num_centroids > 1:
        mask[1, 2:] = mask[-1] = False
    index = np.where(mask, index, index[:, :1]).astype(np.int32)
    points, centroids = generator.normal(size=(NUM_POINTS, 3)), generator.normal(size=(num_centroids, 3))
    sq_distance = np.sum((points[index] - centroids[:, None]) ** 2, axis=2)
    groups = Neighbors(index, sq_distance, mask, mask.sum(axis=1).astype(np.int32))
    return Inputs(centroids, points, np.ones(NUM_POINTS, bool), generator.normal(size=(NUM_POINTS, 4)), groups)


def toy_clouds(num_centroids):
    clouds = [toy_inputs(np.random.default_rng(n), num_centroids) for n in range(2)]
    return jax.tree.map(lambda *x: np.stack(x), *clouds)


def cast(tree, dtype):
    return jax.tree.map(lambda x: jnp.asarray(x, dtype if np.issubdtype(x.dtype, np.floating) else x.dtype), tree)


@partial(jax.jit, static_argnames=("grouped", "train"))
def abstract(variables, clouds, *, grouped, train):
    module = SetAbstraction(WIDTHS, grouped)
    mutable = ["batch_stats"] if train else False
    apply = partial(module.apply, variables, train=train, mutable=mutable)
    found = jax.vmap(lambda one: apply(*one), axis_name="cloud")(clouds)
    return found[0] if train else found


def rectified(x, mask, variables, train):
    """BatchNorm over the valid rows of all clouds, then ReLU."""
    params, stats = variables
    mean, variance = (x[mask].mean(axis=0), x[mask].var(axis=0)) if train else (stats["mean"], stats["variance"])
    return np.maximum((x - mean) / np.sqrt(variance + EPSILON) * params["scale"] + params["shift"], 0)


def pointwise(x, mask, params, stats, train, num_layers):
    for number in range(num_layers):
        name = f"BatchNorm_{number}"
        x = rectified(x @ params[f"Dense_{number}"]["kernel"], mask, (params[name], stats[name]), train)
    return x


def reference(variables, clouds, grouped, train):
    """Features of all centroids, by loops."""
    params, stats, groups = variables["params"], variables["batch_stats"], clouds.groups
    out = np.full((*groups.index.shape[:2], WIDTHS[-1]), -np.inf)
    origin = 0 * clouds.centroids if clouds.centroids.shape[1] == 1 else clouds.centroids
    if grouped:
        rows = np.zeros((*groups.index.shape, 7))
        for b, i, j in np.ndindex(*groups.index.shape):
            row = groups.index[b, i, j]
            rows[b, i, j] = [*(clouds.points[b, row] - origin[b, i]), *clouds.features[b, row]]
        edges = pointwise(rows, groups.mask, params["mlp"], stats["mlp"], train, 2)
    else:
        features = pointwise(clouds.features, clouds.mask, params["mlp"], stats["mlp"], train, 1)
        edges = np.zeros((*groups.index.shape, WIDTHS[-1]))
        for b, i, j in np.ndindex(*groups.index.shape):
            row = groups.index[b, i, j]
            way = clouds.points[b, row] - origin[b, i]
            edges[b, i, j] = features[b, row] @ params["edge"]["kernel"] + way @ params["place"]["kernel"]
    for b, i, j, c in np.ndindex(*edges.shape):
        if groups.mask[b, i, j] or j == 0:  # padding repeats the first
            out[b, i, c] = max(out[b, i, c], edges[b, i, j, c])
    if grouped:
        return out
    return rectified(out, groups.mask.any(axis=2), (params["norm"], stats["norm"]), train)


def cast64(tree):
    return jax.tree.map(lambda x: np.asarray(x, np.float64), tree)


@pytest.fixture(scope="module", params=[(True, 4), (False, 4), (True, 1), (False, 1)], ids=str)
def case(request, toy):
    grouped, num_centroids = request.param
    clouds = toy_clouds(num_centroids)
    one = cast(jax.tree.map(lambda x: x[0], clouds), np.float32)
    return grouped, clouds, toy.variables_of(SetAbstraction(WIDTHS, grouped), *one, train=False)


@pytest.mark.parametrize("train", [False, True])
def test_values_are_those_of_the_loop(case, train):
    grouped, clouds, variables = case
    found = abstract(variables, cast(clouds, np.float32), grouped=grouped, train=train)
    np.testing.assert_allclose(found, reference(cast64(variables), clouds, grouped, train), atol=1e-5, rtol=1e-5)


def test_gradients_are_the_slopes_of_the_loop(case, x64):
    grouped, clouds, variables = case
    generator, variables = np.random.default_rng(3), cast64(variables)
    cotangent = generator.normal(size=(*clouds.centroids.shape[:2], WIDTHS[-1]))

    def score(free, out_of):
        return jnp.sum(cotangent * out_of({**variables, "params": free[0]}, clouds._replace(features=free[1])))

    def layer(variables, clouds):
        return abstract(variables, cast(clouds, np.float64), grouped=grouped, train=True)

    free = (variables["params"], clouds.features)
    slopes = jax.grad(partial(score, out_of=layer))(free)
    along = jax.tree.map(lambda x: generator.normal(size=x.shape), free)
    ends = [
        score(jax.tree.map(lambda x, d: x + h * d, free, along), lambda v, c: reference(v, c, grouped, True))  # noqa: B023
        for h in (1e-6, -1e-6)
    ]
    ours = sum(np.sum(s * d) for s, d in zip(jax.tree.leaves(slopes), jax.tree.leaves(along), strict=True))
    np.testing.assert_allclose(ours, (ends[0] - ends[1]) / 2e-6, rtol=1e-4, atol=1e-4)


def test_a_single_centroid_sees_absolute_positions(case):
    grouped, clouds, variables = case
    elsewhere = clouds._replace(centroids=clouds.centroids + 5)
    one, other = (abstract(variables, cast(c, np.float32), grouped=grouped, train=False) for c in (clouds, elsewhere))
    assert np.array_equal(one, other) == (clouds.centroids.shape[1] == 1)


def test_the_order_of_neighbors_is_nothing(case):
    grouped, clouds, variables = case
    groups = clouds.groups
    full = groups._replace(mask=np.ones_like(groups.mask))
    turned = Neighbors(full.index[:, :, ::-1], full.sq_distance[:, :, ::-1], full.mask, full.count)
    one, other = (
        abstract(variables, cast(clouds._replace(groups=g), np.float32), grouped=grouped, train=False)
        for g in (full, turned)
    )
    np.testing.assert_allclose(one, other, atol=1e-6)
