"""The statistical outlier filter (paper, section 4.1) and the rule that decides whether a scan needs it.

    d_i = mean distance of point i to its K nearest,    kept iff d_i < mean(d) + deviations * std(d)

in the convention of Open3D, whose kept set this reproduces: the K nearest include the point itself, the standard
deviation divides by n - 1, the comparison is strict. As a cloud without outliers loses 2-3 % of its points to this
filter, "auto" applies it only where it finds isolated points. All in float64 on the host, in the input's unit.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int32, Num

from jprimfit.geometry import host

Mode = Literal["auto", "on", "off"]

# A point is isolated if its neighbours lie 2.5 times farther than those of a quarter of its neighbours; a cloud has
# outliers if 0.1 % of its points are. Clean CAD samples stay below 2.2 (uniform) and 0.05 % (Gaussian noise of 1 %).
ISOLATION = 2.5
ISOLATED_SHARE = 1e-3
# No point within twice the median distance is taken for an outlier by "auto": edges and noise reach 1.9.
MEDIAN_FACTOR = 2.0
MAX_PASSES = 2


class NeighborDistances(NamedTuple):
    """How far the surroundings of each of n points lie, and who they are."""

    mean: Float64[np.ndarray, "n"]  # mean distance to the K nearest, the point itself (0) included, input unit
    isolation: Float64[np.ndarray, "n"]  # mean over the lower quartile of the neighbours' means; about 1 in a surface
    index: Int32[np.ndarray, "n k"]  # the neighbours, by distance


class Outliers(NamedTuple):
    """What the filter decided about n points."""

    keep: Bool[np.ndarray, "n"]
    thresholds: tuple[float, ...]  # the largest mean distance kept, one per pass; empty if the filter did not run
    isolated_share: float  # share of isolated points in the whole cloud, 0 to 1
    neighbors: Int32[np.ndarray, "n k"] | None = None  # by distance, the point first, where all have k and are kept


def neighbor_distances(points: Num[np.ndarray, "n 3"], *, k: int = 16) -> NeighborDistances:
    """Mean distance to the k nearest (fewer in a smaller cloud), and the same relative to the neighbours' own."""
    neighbors = host.knn(points, points, k=k)
    count = neighbors.mask.sum(axis=1)
    mean = np.sqrt(np.asarray(neighbors.sq_distance)).sum(axis=1, where=neighbors.mask) / count
    place = neighbors.index.shape[1] // 4
    quartile = np.partition(mean[neighbors.index], place, axis=1)[:, place]
    isolation = np.divide(mean, quartile, out=np.ones_like(mean), where=quartile > 0.0)
    return NeighborDistances(mean, isolation, np.asarray(neighbors.index))


def statistical_threshold(mean_distance: Float64[np.ndarray, "n"], *, deviations: float = 2.0) -> float:
    """Mean plus deviations * std of the mean distances (ddof = 1); infinite where all are equal: nothing stands out."""
    spread = float(mean_distance.std(ddof=1)) if len(mean_distance) > 1 else 0.0
    # Rounding gives equal distances a spread of some 1e-16 of their size.
    return float(mean_distance.mean()) + deviations * spread if spread > 1e-12 * mean_distance.max() else np.inf


def statistical_filter(
    points: Num[np.ndarray, "n 3"], *, k: int = 16, deviations: float = 2.0
) -> Bool[np.ndarray, "n"]:
    """Mask of the points that the filter keeps, True = kept: d_i < mean + deviations * std.

    Open3D's remove_statistical_outlier(k, deviations), except that it also drops points of which there are k or more
    copies at one place, and everything where all distances are equal; here these stay.
    """
    mean = neighbor_distances(points, k=k).mean
    return mean < statistical_threshold(mean, deviations=deviations)


def find_outliers(
    points: Num[np.ndarray, "n 3"], *, mode: Mode = "auto", k: int = 16, deviations: float = 2.0
) -> Outliers:
    """Which points of a scan are outliers.

    "on" is one pass of the filter, "off" keeps all. "auto" runs the filter while isolated points are found, at most
    twice (the first pass takes away far outliers, whose distances widen the threshold), and never removes a point
    whose mean distance is below twice the median. ValueError for any other mode.
    """
    passes = {"auto": MAX_PASSES, "on": 1, "off": 0}
    if mode not in passes:
        raise ValueError(f"filter is {mode!r}, but there are only 'auto', 'on' and 'off': give one of them.")
    keep, thresholds, first_share, neighbors = np.ones(len(points), bool), [], 0.0, None
    for number in range(passes[mode]):
        rows = np.flatnonzero(keep)
        mean, isolation, neighbors = neighbor_distances(points[rows], k=k)
        share = float((isolation > ISOLATION).mean())
        first_share = first_share if number else share
        if mode == "auto" and share < ISOLATED_SHARE:
            break
        threshold = statistical_threshold(mean, deviations=deviations)
        if mode == "auto":
            threshold = max(threshold, MEDIAN_FACTOR * float(np.median(mean)))
        keep[rows[mean >= threshold]] = False
        thresholds.append(threshold)
    if not keep.all() or len(points) < k:
        neighbors = None
    return Outliers(keep, tuple(thresholds), first_share, neighbors)
