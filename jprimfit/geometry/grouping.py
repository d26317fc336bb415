"""Groups of points around centroids, with a radius that follows the local density.

The adaptive radius of a centroid is the distance to its K-th nearest point (paper, section 5.2): small where the scan
is dense, large where it is sparse. The ball of that radius holds the K nearest points and no other (up to ties), so a
group is a kNN query whose reach may be capped. Letters: n points, m centroids, k neighbours.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from jprimfit.geometry import safe
from jprimfit.geometry.neighbors import knn
from jprimfit.types import Neighbors


class Groups(NamedTuple):
    """The points around each of m centroids, and how far each group reaches."""

    neighbors: Neighbors  # points[index[i, j]] is the j-th nearest to centroid i, up to radius[i]
    radius: Float[Array, "m"]  # distance to the K-th neighbour or the cap, whichever is smaller, in the cloud's unit


def adaptive_groups(
    centroids: Float[Array, "m 3"],
    points: Float[Array, "n 3"],
    point_mask: Bool[Array, "n"] | None = None,
    *,
    k: int,
    max_radius: float = math.inf,
) -> Groups:
    """The K = k nearest points to each centroid, less those at max_radius or farther."""
    return within(knn(centroids, points, point_mask, k=k), max_radius=max_radius)


def within(neighbors: Neighbors, *, max_radius: float) -> Groups:
    """The same neighbourhoods, less the neighbours at max_radius or farther.

    Rows must be ordered by distance. What drops out becomes padding as in Neighbors; count becomes the number that
    is left, so it never exceeds k.
    """
    if neighbors.index.shape[1] == 0:  # no groups were asked for
        none = neighbors._replace(count=jnp.zeros(len(neighbors.index), jnp.int32))
        return Groups(none, jnp.zeros(len(neighbors.index), neighbors.sq_distance.dtype))
    mask = neighbors.mask & (neighbors.sq_distance < max_radius**2)
    # Rows are ordered by distance, so a row that keeps anything keeps its first neighbour.
    some = mask[:, :1]
    index = jnp.where(mask, neighbors.index, jnp.where(some, neighbors.index[:, :1], 0))
    sq_distance = jnp.where(mask, neighbors.sq_distance, jnp.where(some, neighbors.sq_distance[:, :1], 0))
    count = jnp.sum(mask, axis=1, dtype=jnp.int32)
    radius = jnp.minimum(safe.sqrt(jnp.max(neighbors.sq_distance, axis=1)), max_radius)
    return Groups(Neighbors(index, sq_distance, mask, count), radius)


def gather(features: Shaped[Array, "n *channels"], index: Int[Array, "m k"]) -> Shaped[Array, "m k *channels"]:
    """The features of each neighbour: result[i, j] = features[index[i, j]]; padding repeats the first neighbour's."""
    return features[index]


def relative_positions(
    centroids: Float[Array, "m 3"], points: Float[Array, "n 3"], index: Int[Array, "m k"]
) -> Float[Array, "m k 3"]:
    """The way from each centroid to its neighbours: points[index[i, j]] - centroids[i]; padding repeats the first."""
    return gather(points, index) - centroids[:, None, :]
