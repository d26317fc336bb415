"""Features carried from coarse to fine points by inverse distance over the three nearest (paper, section 6.2).

    v(q) = sum_j w_j v_j / sum_j w_j,    w_j = 1 / max(d_j^2, 1e-10)

The floor lies on d^2 and not on the sum of the weights, because at d = 0 the weight itself is infinite: a query that
lies on a point gets that point's feature. Letters: n coarse points, m queries, k neighbours, c channels.
"""

import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jprimfit.geometry import safe
from jprimfit.geometry.neighbors import knn
from jprimfit.types import Neighbors

MIN_SQ_DISTANCE = 1e-10


class InterpolationWeights(NamedTuple):
    """The value at query i is the sum over j of weight[i, j] * value[index[i, j]]."""

    index: Int[Array, "m k"]  # int32, rows of the coarse points
    weight: Float[Array, "m k"]  # sums to 1 in each row, 0 in padding and in rows without any neighbour


def inverse_distance(
    queries: Float[Array, "m 3"],
    points: Float[Array, "n 3"],
    point_mask: Bool[Array, "n"] | None = None,
    *,
    k: int = 3,
) -> InterpolationWeights:
    """Weights 1 / max(d^2, 1e-10), normalised, of the k nearest valid points to each query."""
    return from_neighbors(knn(queries, points, point_mask, k=k))


def from_neighbors(neighbors: Neighbors) -> InterpolationWeights:
    """Weights 1 / max(d^2, 1e-10), normalised, of neighbours that are already known."""
    inverse = jnp.where(neighbors.mask, 1 / jnp.maximum(neighbors.sq_distance, MIN_SQ_DISTANCE), 0)
    return InterpolationWeights(neighbors.index, safe.divide(inverse, jnp.sum(inverse, axis=1, keepdims=True)))


def interpolate(features: Float[Array, "n c"], weights: InterpolationWeights) -> Float[Array, "m c"]:
    """Features of the n coarse points carried to the m queries: a convex combination of each query's neighbours."""
    # A neighbour at a time: on a CPU one sum over their axis takes XLA fifty times as long.
    terms = (weights.weight[:, j, None] * features[weights.index[:, j]] for j in range(weights.index.shape[1]))
    return functools.reduce(operator.add, terms)
