"""Gaussian smoothing of a scan over nearest neighbours (paper, section 4.2).

    p_i' = sum_j w_ij p_j / sum_j w_ij,    w_ij = exp(-|p_i - p_j|^2 / (2 sigma^2)),    j among the k nearest of i

with sigma in multiples of the scan's mean spacing. The paper sums over all points, at n^2 cost. Smoothing pulls a
curved surface inwards, by about sigma^2 / radius on a sphere: it may feed the network, but parameters are to be fitted
to the raw points. Float64 on the host, in the input's unit.
"""

import numpy as np
from jaxtyping import Float64, Num

from jprimfit.geometry import host


def mean_spacing(sq_distance: Num[np.ndarray, "n k"]) -> float:
    """Mean distance to the nearest other point, from rows of squared distances that begin with the point itself."""
    return float(np.sqrt(sq_distance[:, 1]).mean()) if sq_distance.shape[1] > 1 else 0.0


def gaussian_smooth(
    points: Num[np.ndarray, "n 3"], *, k: int = 16, bandwidth: float = 2.0
) -> Float64[np.ndarray, "n 3"]:
    """Each point replaced by the Gaussian-weighted mean of its k nearest, itself included.

    Args:
        points: positions in any unit.
        k: neighbours, fewer in a smaller cloud.
        bandwidth: sigma of the kernel in mean distances to the nearest other point. Two such distances are about one
            side of the square that a point occupies on a randomly sampled surface.
    """
    points = np.asarray(points, np.float64)
    neighbors = host.knn(points, points, k=k)
    sigma = bandwidth * mean_spacing(np.asarray(neighbors.sq_distance))
    if sigma == 0.0:
        return points.copy()
    smoothed = np.empty_like(points)
    for start in range(0, len(points), host.CHUNK):
        rows = slice(start, start + host.CHUNK)
        weight = np.exp(neighbors.sq_distance[rows] / (-2.0 * sigma**2)) * neighbors.mask[rows]
        weight /= weight.sum(axis=1, keepdims=True)
        # Offsets from the point itself are small numbers, whatever the position of the cloud.
        offset = points[neighbors.index[rows]] - points[rows, None, :]
        smoothed[rows] = points[rows] + np.einsum("mk,mkc->mc", weight, offset)
    return smoothed
