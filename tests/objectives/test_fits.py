"""All kinds on all columns, and the choice among them, against the fitters asked one by one."""

import jax
import jax.numpy as jnp
import numpy as np

from jprimfit.objectives import fits, memberships
from jprimfit.primitives.table import KINDS, MODULES

FIT = jax.jit(fits.fit_columns)
KIND = np.array([0, 1, 2, 3, 0, 0])


def test_every_column_has_the_primitive_of_its_points(part, tolerance):
    own = memberships.of_truth(part.truth)
    surfaces, ok = FIT(part.points, own, part.truth.normals)
    for k, primitive in enumerate(part.primitives):
        assert ok[k, k]
        found = jax.tree.map(lambda x, k=k: x[k], surfaces[k])
        expected = type(primitive)(*[jnp.float32(value) for value in primitive])
        apart = MODULES[primitive.kind].discrepancy(found, expected)
        np.testing.assert_allclose(apart, 0, atol=10 * tolerance["float32"])
    assert not np.asarray(ok)[:, 4:].any()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(surfaces))


def test_axes_and_distances_are_those_of_the_kind_asked_for(part, tolerance):
    own = memberships.of_truth(part.truth)
    surfaces, _ = FIT(part.points, own, part.truth.normals)
    kind = KIND[[1, 2, 3, 0, 1, 2]]
    samples = np.random.default_rng(0).normal(size=(6, 5, 3)).astype(np.float32)
    axes, distances = jax.jit(lambda *x: (fits.axes(*x[:2]), fits.distances(*x)))(surfaces, kind, samples)
    for column, number in enumerate(kind):
        primitive = jax.tree.map(lambda x, column=column: x[column], surfaces[number])
        expected = MODULES[KINDS[number]].distance(primitive, jnp.asarray(samples[column]))
        np.testing.assert_allclose(distances[column], expected, atol=tolerance["float32"])
        axis = np.zeros(3) if number == 1 else primitive[0]
        np.testing.assert_array_equal(axes[column], axis)
