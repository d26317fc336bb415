"""Dense layers and batch normalisation against NumPy, over clouds and devices, with masks."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.networks.layers import EPSILON, MOMENTUM, BatchNorm, Pointwise

GENERATOR = np.random.default_rng(0)
ROWS = GENERATOR.normal(size=(4, 7, 3, 5)).astype(np.float32) * 2 + 1  # clouds, m, k, c
MASK = GENERATOR.uniform(size=(4, 7, 3)) < 0.6


def normalise(module, variables, rows, mask, *, names):
    """Training mode under a vmap for every name."""

    def one(rows, mask):
        return module.apply(variables, rows, mask, train=True, mutable=["batch_stats"])

    for name in names:
        one = jax.vmap(one, axis_name=name)
    return jax.jit(one)(rows, mask)


def numpy_statistics(rows, mask):
    valid = rows[mask].astype(np.float64)
    return valid.mean(axis=0), valid.var(axis=0)


def test_statistics_run_over_all_valid_rows_of_all_clouds(toy, tolerance):
    module = BatchNorm()
    variables = toy.variables_of(module, ROWS[0], MASK[0], train=False)
    found, changed = normalise(module, variables, ROWS, MASK, names=("cloud",))
    mean, variance = numpy_statistics(ROWS, MASK)
    params, stats = variables["params"], variables["batch_stats"]
    expected = (ROWS - mean) / np.sqrt(variance + EPSILON) * params["scale"] + params["shift"]
    np.testing.assert_allclose(found, expected, atol=tolerance["float32"])
    for row in range(4):  # every cloud is told the same
        new = jax.tree.map(lambda x, row=row: x[row], changed["batch_stats"])
        np.testing.assert_allclose(new["mean"], MOMENTUM * stats["mean"] + (1 - MOMENTUM) * mean, atol=1e-5)
        np.testing.assert_allclose(new["variance"], MOMENTUM * stats["variance"] + (1 - MOMENTUM) * variance, atol=1e-5)


def test_a_batch_over_two_axes_is_one_batch(toy, tolerance):
    module = BatchNorm(axis_names=("cloud", "device"))
    variables = toy.variables_of(module, ROWS[0], MASK[0], train=False)
    whole = normalise(BatchNorm(), variables, ROWS, MASK, names=("cloud",))
    split = jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), (ROWS, MASK))
    parts = normalise(module, variables, *split, names=("cloud", "device"))
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        np.testing.assert_allclose(other.reshape(one.shape), one, atol=tolerance["float32"])


def test_masked_rows_count_in_nothing(toy):
    module = BatchNorm()
    variables = toy.variables_of(module, ROWS[0], MASK[0], train=False)
    elsewhere = np.where(MASK[..., None], ROWS, 1e3).astype(np.float32)
    one, stats = normalise(module, variables, ROWS, MASK, names=("cloud",))
    other, other_stats = normalise(module, variables, elsewhere, MASK, names=("cloud",))
    np.testing.assert_array_equal(np.asarray(one)[MASK], np.asarray(other)[MASK])
    jax.tree.map(np.testing.assert_array_equal, stats, other_stats)


def test_evaluation_uses_the_running_statistics(toy, tolerance):
    module = BatchNorm()
    variables = toy.variables_of(module, ROWS[0], MASK[0], train=False)
    params, stats = variables["params"], variables["batch_stats"]
    expected = (ROWS[0] - stats["mean"]) / np.sqrt(stats["variance"] + EPSILON) * params["scale"] + params["shift"]
    found = module.apply(variables, jnp.asarray(ROWS[0]), jnp.asarray(MASK[0]), train=False)
    np.testing.assert_allclose(found, expected, atol=tolerance["float32"])


@pytest.mark.parametrize("rows", [np.zeros((3, 4, 2)), np.ones((3, 4, 2))])
@pytest.mark.parametrize("valid", [0, 1])
def test_constant_or_no_rows_are_finite_with_their_gradient(toy, rows, valid):
    rows, mask = rows.astype(np.float32), np.arange(12).reshape(3, 4) < valid
    module = BatchNorm()
    variables = toy.variables_of(module, rows[0], mask[0], train=False)

    @jax.jit
    @jax.grad
    def slope(rows):
        apply = partial(module.apply, variables, train=True, mutable=["batch_stats"])
        found, changed = jax.vmap(apply, axis_name="cloud")(rows, mask)
        return jnp.sum(jnp.sin(found)) + sum(jnp.sum(leaf) for leaf in jax.tree.leaves(changed))

    assert np.all(np.isfinite(slope(rows)))


def test_pointwise_is_dense_normalised_and_cut_at_zero(toy, tolerance):
    module = Pointwise((4, 3))
    variables = toy.variables_of(module, ROWS[0], MASK[0], train=False)
    x = ROWS[0].astype(np.float64)
    for layer in range(2):
        params, stats = variables["params"][f"BatchNorm_{layer}"], variables["batch_stats"][f"BatchNorm_{layer}"]
        x = x @ variables["params"][f"Dense_{layer}"]["kernel"]
        x = (x - stats["mean"]) / np.sqrt(stats["variance"] + EPSILON) * params["scale"] + params["shift"]
        x = np.maximum(x, 0)
    found = module.apply(variables, jnp.asarray(ROWS[0]), jnp.asarray(MASK[0]), train=False)
    np.testing.assert_allclose(found, x, atol=tolerance["float32"])
    rows, mask = jnp.asarray(ROWS[0]), jnp.asarray(MASK[0])
    np.testing.assert_array_equal(Pointwise(()).apply({}, rows, mask, train=True), rows)
