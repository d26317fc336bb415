"""Tiny clouds and random variables, which spare the tests a compiled initialisation."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.geometry.hierarchy import HierarchySpec, from_index_sets
from jprimfit.geometry.preparation import prepare
from jprimfit.networks.segmenter import Segmenter

INF = float("inf")
SPEC = HierarchySpec((12, 5), (6, 4), (0, 4), (6, 4), (0.5, 1.0), (0.1, 0.2), (INF, INF))


def cloud(num_valid=40, num_points=40, *, seed=0, spec=SPEC):
    """A prepared cloud in a box, its padding at the end."""
    points = np.random.default_rng(seed).uniform(-1, 1, (num_valid, 3)).astype(np.float32)
    return prepare(points, spec=spec, neighborhoods=(6, 9), num_points=num_points, workers=1)


def variables_of(module, *inputs, seed=0, **options):
    """Random variables in the shapes that the module wants: every scale, shift and statistic differs from its start."""
    generator = np.random.default_rng(seed)

    def fill(path, leaf):
        values = generator.normal(size=leaf.shape)
        name = path[-1].key
        if name == "kernel":
            values /= np.sqrt(leaf.shape[0])
        elif name in ("scale", "variance"):
            values = generator.uniform(0.5, 1.5, leaf.shape)
        else:
            values *= 0.2
        return np.asarray(values, leaf.dtype)

    shapes = jax.eval_shape(partial(module.init, **options), jax.random.key(0), *inputs)
    return jax.tree_util.tree_map_with_path(fill, shapes)


@partial(jax.jit, static_argnames=("config", "train"))
def answer(variables, prepared, query=None, segments=None, *, config, train=False):
    """Prediction of one cloud; in training a pair, with the changed statistics of a batch of one."""

    def one(prepared, query, segments):
        hierarchy = from_index_sets(prepared.points, prepared.sets, prepared.mask)
        inputs = (prepared.points, hierarchy, prepared.local_normals, prepared.curvature, query)
        mutable = ["batch_stats"] if train else False
        return Segmenter(config).apply(variables, *inputs, train=train, segments=segments, mutable=mutable)

    batch = jax.tree.map(lambda x: x[None], (prepared, query, segments))
    return jax.tree.map(lambda x: x[0], jax.vmap(one, axis_name="cloud")(*batch))


class Toy:
    """What the tests here share."""

    spec = SPEC
    cloud = staticmethod(cloud)
    variables_of = staticmethod(variables_of)
    answer = staticmethod(answer)

    @staticmethod
    def segmenter_variables(config, *, seed=0):
        """Random variables of a whole network."""
        prepared = jax.tree.map(jnp.asarray, cloud(spec=config.hierarchy))
        hierarchy = from_index_sets(prepared.points, prepared.sets, prepared.mask)
        inputs = (prepared.points, hierarchy, prepared.local_normals, prepared.curvature)
        segments = jnp.ones((len(prepared.points), 3)) if config.types == "pooled" else None
        return variables_of(Segmenter(config), *inputs, seed=seed, segments=segments)


@pytest.fixture(scope="session")
def toy():
    """Clouds of up to 40 points, their variables and answers."""
    return Toy
