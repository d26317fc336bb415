"""Polynomials of degree two in space, and what noise adds to their products.

A polynomial x·Mx + b·x + c is ten coefficients (M's six, b, c) over the monomials (xx, yy, zz, 2xy, 2xz, 2yz, x, y, z,
1). Let a point be x + e with e ~ N(0, v I). Then F' = exp(-v Laplace / 2) F, taken at the point, has the expectation
F(x), wherever x is. For a product F = a b of two such polynomials F' - F is of degree two again: `noise_term`.
n points.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jprimfit.geometry.linalg import HIGHEST

_ROW, _COLUMN = jnp.array([0, 1, 2, 0, 0, 1]), jnp.array([0, 1, 2, 1, 2, 2])  # of the first six coefficients in M


class Quadric(NamedTuple):
    """The surface f = 0, and L(x) = slope·x + height with |grad f| = 2 |L| on that surface."""

    polynomial: Float[Array, "10"]  # f
    height: Float[Array, ""]
    slope: Float[Array, "3"] | None = None  # None: L is constant


def polynomial(
    matrix: Float[Array, "3 3"], vector: Float[Array, "3"], constant: Float[Array, ""]
) -> Float[Array, "10"]:
    """Coefficients of x·Mx + b·x + c, for a symmetric M."""
    return jnp.concatenate([matrix[_ROW, _COLUMN], vector, constant[None]])


def monomials(points: Float[Array, "n 3"]) -> Float[Array, "n 10"]:
    """The ten monomials at each point: times the coefficients, the value of a polynomial."""
    x, y, z = points.T
    columns = [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, x, y, z, jnp.ones_like(x)]
    return jnp.stack(columns, axis=1)


def noise_term(a: Float[Array, "10"], b: Float[Array, "10"], variance: Float[Array, ""]) -> Float[Array, "10"]:
    """exp(-v Laplace / 2) (a b) - a b: -v (a tr B + b tr A + grad a·grad b) + v^2 (tr A tr B + 2 A:B)."""
    (matrix_a, vector_a, _), (matrix_b, vector_b, _) = _split(a), _split(b)
    trace_a, trace_b = jnp.trace(matrix_a), jnp.trace(matrix_b)
    product = 2 * jnp.matmul(matrix_a, matrix_b, precision=HIGHEST)
    vector = 2 * (jnp.matmul(matrix_a, vector_b, precision=HIGHEST) + jnp.matmul(matrix_b, vector_a, precision=HIGHEST))
    gradients = polynomial(product + product.T, vector, jnp.sum(vector_a * vector_b))
    constant = trace_a * trace_b + 2 * jnp.sum(matrix_a * matrix_b)
    return (-variance * (a * trace_b + b * trace_a + gradients)).at[9].add(variance * variance * constant)


def derivative(a: Float[Array, "10"], direction: Float[Array, "3"]) -> Float[Array, "10"]:
    """Coefficients of direction·grad a."""
    matrix, vector, _ = _split(a)
    slope = 2 * jnp.matmul(matrix, direction, precision=HIGHEST)
    return polynomial(jnp.zeros_like(matrix), slope, jnp.sum(direction * vector))


def _split(a: Float[Array, "10"]) -> tuple[Float[Array, "3 3"], Float[Array, "3"], Float[Array, ""]]:
    xx, yy, zz, xy, xz, yz = a[:6]
    return jnp.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).reshape(3, 3), a[6:9], a[9]
