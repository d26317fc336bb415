"""Polynomials of degree two in space, x·Mx + b·x + c, and their products with a function under noise.

Let a point be x + e with e ~ N(0, v I). Then f(X) k, each coordinate x of the polynomial f replaced by the operator
X = x - v d/dx, has at that point the expectation f(x) E[k], wherever x is and whatever smooth function k is: 0 for all
points x of the surface f = 0. That makes an unbiased equation of any k. For degree two
    f(X) k = (f - v tr M) k - v grad f·grad k + v^2 M : hess k.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jprimfit.geometry.linalg import HIGHEST


class Quadric(NamedTuple):
    """The polynomial x·Mx + b·x + c."""

    frame: Float[Array, "3 3"]  # rows are the directions of M's eigenvalues, orthonormal
    curvature: Float[Array, "3"]  # those eigenvalues
    vector: Float[Array, "3"]  # b
    constant: Float[Array, ""]  # c

    @property
    def matrix(self) -> Float[Array, "3 3"]:
        """M, symmetric."""
        return jnp.matmul(self.frame.T * self.curvature[None, :], self.frame, precision=HIGHEST)

    def value(self, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """The polynomial at each point."""
        square = jnp.sum(jnp.matmul(points, self.matrix, precision=HIGHEST) * points, axis=1)
        return square + jnp.matmul(points, self.vector, precision=HIGHEST) + self.constant
