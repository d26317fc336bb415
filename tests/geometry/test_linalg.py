"""Moments against a NumPy loop, eigenvectors against eigh and finite differences, normal equations against lstsq."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jprimfit.geometry import linalg

eigen_smallest = jax.jit(linalg.eigen_smallest)
smallest_of_symmetric_part = jax.jit(lambda m: linalg.smallest_eigenvector((m + m.T) / 2))
values_of_symmetric_part = jax.jit(lambda m: linalg.eigen_smallest((m + m.T) / 2).values)
derivatives_of_eigen = jax.jit(lambda m: (jax.jacrev(linalg.eigen_smallest)(m), jax.jacfwd(linalg.eigen_smallest)(m)))
ridge_solve = jax.jit(linalg.ridge_solve)
solution_of = jax.jit(lambda r, v, w: linalg.ridge_solve(r, v, w).x)
derivatives_of_solution = jax.jit(jax.jacrev(solution_of, argnums=(0, 1, 2)))
frame_of = jax.jit(lambda axis: (linalg.frame_of(axis), jax.jacrev(linalg.frame_of)(axis)))


def symmetric(values):
    frame, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    return jnp.asarray((frame * np.array(values, float)) @ frame.T)


def finite(tree):
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


def test_moments_agree_with_a_loop(x64, tolerance):
    points = jnp.asarray(np.random.default_rng(0).normal(size=(7, 3)))
    weights = jnp.array([1.0, 2.0, 0.0, 0.5, 1.0, 3.0, 0.1])
    total, mean, scatter = 0.0, np.zeros(3), np.zeros((3, 3))
    for p, w in zip(np.asarray(points), np.asarray(weights), strict=True):
        total, mean = total + w, mean + w * p
    for p, w in zip(np.asarray(points), np.asarray(weights), strict=True):
        scatter += w * np.outer(p - mean / total, p - mean / total)
    result = linalg.moments(points, weights)
    np.testing.assert_allclose(result.mean, mean / total, atol=tolerance["float64"])
    np.testing.assert_allclose(result.covariance, scatter / total, atol=tolerance["float64"])
    np.testing.assert_allclose(result.weight, total)
    np.testing.assert_allclose(linalg.weighted_mean(points, weights), mean / total)


def test_moments_keep_their_digits_far_from_the_origin(tolerance):
    points = jnp.asarray(np.random.default_rng(0).integers(-64, 64, (200, 3)) / 64, jnp.float32)
    near, far = (linalg.moments(points + shift, jnp.ones(200)) for shift in (0.0, 1024.0))
    np.testing.assert_allclose(far.covariance, near.covariance, atol=tolerance["float32"])


def test_moments_without_weight_are_zero_with_finite_derivatives():
    points = jnp.asarray(np.random.default_rng(1).normal(size=(5, 3)), jnp.float32)
    result = linalg.moments(points, jnp.zeros(5))
    assert all(float(jnp.abs(leaf).max()) == 0 for leaf in result)
    assert finite(jax.jit(jax.jacrev(linalg.moments, argnums=(0, 1)))(points, jnp.zeros(5)))


def test_derivatives_of_moments(x64):
    points, weights = jnp.asarray(np.random.default_rng(1).normal(size=(6, 3))), jnp.linspace(0.1, 1, 6)
    check_grads(jax.jit(linalg.moments), (points, weights), order=1, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("values", [(0.1, 1, 2), (0.1, 1, 1), (0, 1, 1), (0.2, 0.3, 5)])
def test_eigen_smallest_and_its_derivative(x64, values):
    matrix = symmetric(values)
    vector, found = eigen_smallest(matrix)
    np.testing.assert_allclose(found, values, atol=1e-12)
    np.testing.assert_allclose(matrix @ vector, values[0] * vector, atol=1e-12)
    assert vector[jnp.argmax(jnp.abs(vector))] > 0
    np.testing.assert_allclose(vector, linalg.smallest_eigenvector(matrix), atol=1e-15)
    check_grads(smallest_of_symmetric_part, (matrix,), order=1, atol=1e-6, rtol=1e-6, eps=1e-6)


def test_derivative_of_eigenvalues(x64):
    check_grads(values_of_symmetric_part, (symmetric((0.1, 1, 2)),), order=1, atol=1e-6, rtol=1e-6, eps=1e-6)


@pytest.mark.parametrize("diagonal", [(0, 0, 0), (1, 1, 1), (1, 1, 2), (1, 2, 2), (0, 0, 1e-30)])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_eigen_derivatives_are_finite_at_repeated_eigenvalues(x64, diagonal, dtype):
    matrix = jnp.diag(jnp.array(diagonal, dtype))
    assert finite((eigen_smallest(matrix), derivatives_of_eigen(matrix)))


@pytest.mark.parametrize("num_unknowns", [2, 3])
def test_ridge_solve_is_least_squares(x64, num_unknowns):
    rng = np.random.default_rng(0)
    rows, values, weights = rng.normal(size=(20, num_unknowns)), rng.normal(size=20), rng.uniform(size=20)
    root = np.sqrt(weights)
    expected = np.linalg.lstsq(rows * root[:, None], values * root, rcond=None)[0]
    solution = ridge_solve(jnp.array(rows), jnp.array(values), jnp.array(weights))
    assert bool(solution.ok)
    np.testing.assert_allclose(solution.x, expected, atol=1e-12)
    np.testing.assert_allclose(solution.condition, np.linalg.cond((rows * weights[:, None]).T @ rows), rtol=1e-8)
    unit_free = ridge_solve(jnp.array(rows * 1e-6), jnp.array(values), jnp.array(weights * 1e9))
    np.testing.assert_allclose(unit_free.x, expected * 1e6, rtol=1e-9)
    check_grads(solution_of, (*map(jnp.array, (rows, values, weights)),), order=1)


def test_ridge_solve_standard_error_is_that_of_repeated_draws(x64):
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(40, 3)) * np.array([1.0, 1.0, 0.2])
    values = rows @ np.array([1.0, 2.0, 3.0]) + 0.1 * rng.normal(size=(500, 40))
    solve = jax.jit(jax.vmap(linalg.ridge_solve, in_axes=(None, 0, None)))
    solutions = solve(jnp.asarray(rows), jnp.asarray(values), jnp.ones(40))
    largest = np.sqrt(np.linalg.eigvalsh(np.cov(np.asarray(solutions.x).T))[-1])
    np.testing.assert_allclose(np.mean(solutions.std), largest, rtol=0.1)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_ridge_solve_of_too_few_rows_is_zero_and_says_so(x64, dtype):
    flat = np.random.default_rng(0).normal(size=(9, 3)) * np.array([1, 1, 1e-4])
    for rows, weights in [(flat, np.ones(9)), (flat + 1, np.zeros(9)), (0 * flat, np.ones(9))]:
        rows, weights = jnp.asarray(rows, dtype), jnp.asarray(weights, dtype)
        solution = ridge_solve(rows, rows[:, 0], weights)
        assert not solution.ok
        np.testing.assert_array_equal(solution.x, 0)
        derivative = derivatives_of_solution(rows, rows[:, 0], weights)
        assert finite((solution.std, derivative))


def test_effective_count():
    assert linalg.effective_count(jnp.array([2.0, 2.0, 2.0, 0.0])) == 3
    assert linalg.effective_count(jnp.zeros(3)) == 0


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 0, -1), (1, 1, 1), (3, -4, 0), (1e-12, 0, 0), (0, 0, 0)])
def test_frame_of_is_right_handed_and_orthonormal(axis, tolerance):
    axis = jnp.array(axis, jnp.float32)
    frame, derivative = map(np.asarray, frame_of(axis))
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=tolerance["float32"])
    np.testing.assert_allclose(np.linalg.det(frame), 1, atol=tolerance["float32"])
    length = np.linalg.norm(np.asarray(axis, float))
    np.testing.assert_allclose(frame[2], np.asarray(axis) / length if length else [0, 0, 1], atol=1e-6)
    assert finite(derivative)


def test_orient_makes_the_largest_component_positive():
    np.testing.assert_array_equal(linalg.orient(jnp.array([1.0, -3.0, 2.0])), [-1, 3, -2])
    np.testing.assert_array_equal(linalg.orient(jnp.array([-1.0, 1.0, 0.0])), [1, -1, 0])
    np.testing.assert_array_equal(linalg.orient(jnp.zeros(3)), np.zeros(3))
