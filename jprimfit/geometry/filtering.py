"""Normals that respect edges: a PCA normal beside an edge is a mixture of two faces, the one behind it is not.

Each normal becomes the mean of its neighbours' normals, up to sign, in which neighbour j of point i counts

    w_ij = exp(-((x_i - x_j)·n_j)^2 / 2 s^2 - c_j / c)

as far as x_i lies on the tangent plane of x_j and the curvature c_j there is low; s and c are what quiet points of the
cloud show, so that noise sets both. A bilateral filter (T. Jones, F. Durand and M. Desbrun, 2003). One function for
NumPy and JAX. n points, k neighbours.
"""

from typing import Any, NamedTuple

from jaxtyping import Bool, Float

from jprimfit.types import Neighbors

FILTERED = 0  # stands for these normals where sizes of neighbourhoods are listed
ROUNDS = 2  # the second with the normals of the first
POWER_STEPS = 3  # towards the largest eigenvector of sum_j w_ij n_j n_j^T, from the normal as it was
QUIET = 0.3  # share of the points that are taken to lie within smooth surface
CURVATURES = 1.5  # quiet curvatures: c
NEAREST = 16  # neighbours that tell the noise
MIN_SCALE = 0.03  # of the median distance to the nearest neighbour: least s
MIN_CURVATURE = 1e-3  # least c


class Filtered(NamedTuple):
    """The local surface at each of n points."""

    normal: Float[Any, "n 3"]  # unit, on the side of the one that was given
    curvature: Float[Any, "n"]  # half the mean squared sine between the neighbours' normals and this, in [0, 1/3]


def bilateral_normals(
    points: Float[Any, "n 3"],
    normals: Float[Any, "n 3"],
    curvature: Float[Any, "n"],
    neighbors: Neighbors,
    mask: Bool[Any, "n"] | None = None,
) -> Filtered:
    """The filtered normals, in NumPy or JAX as the points are.

    Args:
        points: of one cloud, in any unit.
        normals: unit, of either sign, of small neighbourhoods.
        curvature: the surface variation of the same.
        neighbors: of the points among themselves, by distance, the point itself first.
        mask: False = padding, which has no say in s and c.
    """
    xp = points.__array_namespace__()
    index, valid = neighbors.index, neighbors.mask.astype(points.dtype)
    offset = points[:, None, :] - points[index]
    nearest = valid[:, :NEAREST]
    height = xp.einsum("nki,ni->nk", offset[:, :NEAREST], normals) * nearest
    count = xp.maximum(xp.sum(nearest, axis=1), 1)
    thickness = xp.sum(xp.square(height), axis=1) / count - xp.square(xp.sum(height, axis=1) / count)
    second = neighbors.sq_distance[:, min(1, index.shape[1] - 1)]
    scale = xp.sqrt(xp.maximum(_quantile(thickness, mask, QUIET), MIN_SCALE**2 * _quantile(second, mask, 0.5)))
    flat = xp.maximum(CURVATURES * _quantile(curvature, mask, QUIET), MIN_CURVATURE)
    tiny = xp.finfo(points.dtype).tiny
    flatness = valid * xp.exp(-curvature[index] / flat)
    mean, spread = normals, curvature
    for _ in range(ROUNDS):
        others = mean[index]
        height = xp.einsum("nki,nki->nk", offset, others) / xp.maximum(scale, tiny)
        weight = flatness * xp.exp(-0.5 * xp.square(height))
        weight = weight / xp.maximum(xp.sum(weight, axis=1), tiny)[:, None]
        moments = xp.matmul(xp.swapaxes(others * weight[:, :, None], 1, 2), others)
        for _ in range(POWER_STEPS):
            turned = xp.einsum("nij,nj->ni", moments, mean)
            length = xp.sqrt(xp.sum(xp.square(turned), axis=1))[:, None]
            mean = xp.where(length > tiny, turned / xp.maximum(length, tiny), mean)
        spread = (1 - xp.einsum("ni,nij,nj->n", mean, moments, mean)) / 2
    return Filtered(mean.astype(points.dtype), xp.clip(spread, 0, 1 / 3).astype(points.dtype))


def _quantile(values: Float[Any, "n"], mask: Bool[Any, "n"] | None, share: float) -> Any:
    """The value below which this share of the valid ones lie, without interpolation."""
    xp = values.__array_namespace__()
    if mask is None:
        return xp.sort(values)[int(share * (len(values) - 1))]
    ordered = xp.sort(xp.where(mask, values, xp.inf))
    return ordered[(share * (xp.sum(mask) - 1)).astype(int)]
