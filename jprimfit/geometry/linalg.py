"""Small weighted linear algebra: moments, the smallest eigenvector, normal equations, frames.

Everything is centred in two passes and solved at a scale of one, because raw float32 moments of a cloud that lies
100 sizes from the origin hold no digit of its shape. The derivative of the eigenvector is written by hand: that of
eigh is NaN as soon as ANY two eigenvalues are equal, and a square face has two equal ones.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jprimfit.geometry import safe

HIGHEST = jax.lax.Precision.HIGHEST

# Tikhonov term and largest condition number of the normal equations, as in SPFN (Li et al. 2019).
RIDGE = 1e-8
MAX_CONDITION = 1e5


class Moments(NamedTuple):
    """Weighted mean and covariance of a cloud."""

    mean: Float[Array, " d"]
    covariance: Float[Array, "d d"]  # sum w (p - mean)(p - mean)^T / sum w, 0 if no weight
    weight: Float[Array, ""]  # sum w


class Eigen(NamedTuple):
    """The eigenvector of the smallest eigenvalue of a symmetric matrix, and all eigenvalues."""

    vector: Float[Array, "3"]  # unit, its largest component positive
    values: Float[Array, "3"]  # ascending


class LinearSolution(NamedTuple):
    """Solution of a weighted linear least-squares problem, and whether the rows determined it."""

    x: Float[Array, " d"]  # exactly 0, with derivative 0, where ok is False
    ok: Bool[Array, ""]
    condition: Float[Array, ""]  # of the normal equations, inf where ok is False; carries no derivative
    std: Float[Array, ""]  # standard error of x along its worst direction, from the residuals; carries no derivative


def weighted_mean(points: Float[Array, "n d"], weights: Float[Array, " n"]) -> Float[Array, " d"]:
    """Mean sum w p / sum w; the zero vector, with derivative 0, where the weights sum to 0."""
    weighted = jnp.sum(weights[:, None] * points, axis=0)
    return safe.divide(weighted, jnp.sum(weights))


def moments(points: Float[Array, "n d"], weights: Float[Array, " n"]) -> Moments:
    """Weighted mean, covariance (not divided by n - 1) and total weight; rows of weight 0 do not count."""
    # The mean of the shifted points repairs the rounding of the first mean of a cloud far from the origin.
    shift = jax.lax.stop_gradient(weighted_mean(points, weights))
    shifted = points - shift[None, :]
    mean = weighted_mean(shifted, weights)
    centred = shifted - mean[None, :]
    scatter = jnp.matmul((weights[:, None] * centred).T, centred, precision=HIGHEST)
    weight = jnp.sum(weights)
    return Moments(shift + mean, safe.divide(scatter, weight), weight)


def orient(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """The vector or its negative: the one whose component of largest magnitude is positive (the first of equals)."""
    return vector * orientation(vector)


def orientation(vector: Float[Array, "3"]) -> Float[Array, ""]:
    """The sign, 1 or -1, by which `orient` multiplies; a locally constant function, so without derivative."""
    largest = vector[jnp.argmax(jnp.abs(vector))]
    return jnp.where(largest < 0, -1, 1).astype(vector.dtype)


@jax.custom_jvp
def eigen_smallest(matrix: Float[Array, "3 3"]) -> Eigen:
    """Eigenvector of the smallest eigenvalue and all eigenvalues of a symmetric matrix, with finite derivatives.

    With v the smallest eigenvector, V the other two and gap_i = value_0 - value_i, the derivative along dM is
    V diag(gap / (gap^2 + eps^2)) V^T dM v: only the gaps to the smallest eigenvalue enter, so equal larger ones do no
    harm. Where the smallest eigenvalue is not simple the vector is an arbitrary one of its space and the derivative
    is finite and means nothing: compare values[1] - values[0] with values[2].
    """
    values, vectors = jnp.linalg.eigh(matrix)
    return Eigen(orient(vectors[:, 0]), values)


@eigen_smallest.defjvp
def _eigen_smallest_jvp(primals, tangents):
    (matrix,), (matrix_dot,) = primals, tangents
    values, vectors = jnp.linalg.eigh(matrix)
    smallest = orient(vectors[:, 0])
    others = vectors[:, 1:]
    symmetric_dot = (matrix_dot + matrix_dot.T) / 2
    gap = values[0] - values[1:]
    # The constant floor keeps eps^2 above underflow, also at the zero matrix.
    eps = 1e-6 * jnp.max(jnp.abs(values)) + 1e-15
    change = jnp.matmul(others.T, jnp.matmul(symmetric_dot, smallest, precision=HIGHEST), precision=HIGHEST)
    vector_dot = jnp.matmul(others, gap / (gap * gap + eps * eps) * change, precision=HIGHEST)
    values_dot = jnp.einsum("ji,jk,ki->i", vectors, symmetric_dot, vectors, precision=HIGHEST)
    return Eigen(smallest, values), Eigen(vector_dot, values_dot)


def smallest_eigenvector(matrix: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Unit eigenvector of the smallest eigenvalue of a symmetric matrix; see `eigen_smallest`."""
    return eigen_smallest(matrix).vector


def ridge_solve(rows: Float[Array, "n d"], values: Float[Array, " n"], weights: Float[Array, " n"]) -> LinearSolution:
    """The x that minimises sum w (rows·x - values)^2, by Cholesky of the normal equations scaled to mean diagonal 1.

    One step of iterative refinement takes back the bias of the ridge, (RIDGE * condition)^2 is left of it. Beyond
    MAX_CONDITION, and without weight, x is exactly 0 and ok is False: there the rows do not determine x, and its
    derivatives would be as large as the condition number.
    """
    num_unknowns = rows.shape[1]
    identity = jnp.eye(num_unknowns, dtype=rows.dtype)
    weighted_rows = weights[:, None] * rows
    matrix = jnp.matmul(weighted_rows.T, rows, precision=HIGHEST)
    vector = jnp.matmul(weighted_rows.T, values, precision=HIGHEST)
    scale = jnp.trace(matrix) / num_unknowns
    matrix, vector = safe.divide(matrix, scale), safe.divide(vector, scale)
    eigenvalues = jnp.linalg.eigvalsh(jax.lax.stop_gradient(matrix))
    ok = eigenvalues[0] * MAX_CONDITION > eigenvalues[-1]
    condition = jnp.where(ok, safe.divide(eigenvalues[-1], eigenvalues[0]), jnp.inf)
    matrix, vector = jnp.where(ok, matrix, identity), jnp.where(ok, vector, 0)
    factor = jnp.linalg.cholesky(matrix + RIDGE * identity)
    x = _cholesky_solve(factor, vector)
    x = x + _cholesky_solve(factor, vector - jnp.matmul(matrix, x, precision=HIGHEST))
    sq_residual = (jnp.matmul(rows, x, precision=HIGHEST) - values) ** 2
    variance = safe.divide(jnp.sum(weights * sq_residual), scale * eigenvalues[0] * effective_count(weights))
    return LinearSolution(x, ok, condition, jax.lax.stop_gradient(safe.sqrt(jnp.where(ok, variance, 0))))


def effective_count(weights: Float[Array, " n"]) -> Float[Array, ""]:
    """(sum w)^2 / sum w^2: the number of equal weights that average as well; 0 if the weights sum to 0."""
    return safe.divide(jnp.sum(weights) ** 2, jnp.sum(weights * weights))


def _cholesky_solve(factor: Float[Array, "d d"], vector: Float[Array, " d"]) -> Float[Array, " d"]:
    # A column, because a one-dimensional right-hand side is deprecated once vmap has batched it.
    return jax.scipy.linalg.cho_solve((factor, True), vector[:, None])[:, 0]


def frame_of(axis: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Right-handed orthonormal frame with rows u, v, unit(axis); the zero axis counts as (0, 0, 1).

    The coordinates of x in it are frame @ x, and back: frame.T @ coordinates. u and v are a fixed choice: they jump
    where two components of the axis are equal in size, so use them only in results that do not depend on the choice.
    """
    length = safe.norm(axis)
    third = jnp.where(length > 0, safe.unit(axis), jnp.array([0, 0, 1], dtype=axis.dtype))
    helper = jax.nn.one_hot(jnp.argmin(jnp.abs(third)), 3, dtype=axis.dtype)
    first = safe.unit(jnp.cross(third, helper))
    return jnp.stack([first, jnp.cross(third, first), third])
