"""Geometry on the host in float64: kd-tree neighbours, the normalised frame, PCA normals, the host-built hierarchy.

The only file of this folder with scipy and float64, for what runs once per cloud (files, preprocessing, a data
loader). Same conventions as the jitted twins: neighbours ordered by (distance, index), self included, padding as
jprimfit.types.Neighbors says. NumPy in and out. Letters: n points, m queries, k neighbours.
"""

import contextlib
import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float32, Float64, Num
from scipy.spatial import KDTree

from jprimfit.cores import num_cores
from jprimfit.geometry.hierarchy import NUM_INTERPOLATED, Hierarchy, HierarchySpec, Searches, assemble, levels, nearest
from jprimfit.geometry.sampling import optimised_farthest_points
from jprimfit.programs import stored
from jprimfit.types import Neighbors

TIE_DEPTH = 64  # how far behind the k-th place points of equal distance are looked for
CHUNK = 8_192  # rows per pass of a search among ties
FIRST = 8  # rows that decide between axes of equal inertia
TIE_BREAK = 1e-2  # how much they count, beside the mean over all rows
PCA_CHUNK = 2_048  # rows per pass, so that three coordinates of the neighbourhoods stay in the cache


class Frame(NamedTuple):
    """The normalised frame: x_frame = axes (x_input - center) / scale; centroid at 0, longest side of the box 2."""

    center: Float64[np.ndarray, "3"]  # centroid, in the input's unit
    scale: float  # half of the longest side of the box along the axes (1 if all points coincide), in the input's unit
    axes: Float64[np.ndarray, "3 3"]  # a rotation; its rows are the axes of this frame in the input's

    def from_input(self, points: Num[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Points of the input in the normalised frame."""
        return self.vectors_from_input(np.asarray(points, np.float64) - self.center[None, :]) / self.scale

    def to_input(self, points: Num[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Points of the normalised frame in the position and unit of the input."""
        return self.vectors_to_input(np.asarray(points, np.float64) * self.scale) + self.center[None, :]

    def vectors_from_input(self, vectors: Num[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Directions of the input in the normalised frame, their lengths as they are."""
        return np.asarray(vectors, np.float64) @ self.axes.T

    def vectors_to_input(self, vectors: Num[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Directions of the normalised frame in the input."""
        return np.asarray(vectors, np.float64) @ self.axes


class SurfaceNormals(NamedTuple):
    """A normal and a measure of bending for each of n points."""

    normal: Float64[np.ndarray, "n 3"]  # unit, of either sign
    curvature: Float64[np.ndarray, "n"]  # smallest eigenvalue / sum of the eigenvalues, in [0, 1/3]; 0 on a plane


def normalize(points: Num[np.ndarray, "n 3"], *, turned: bool = False) -> tuple[Float32[np.ndarray, "n 3"], Frame]:
    """Shifts and scales n >= 1 points into the normalised frame, in float64, and only then rounds to float32.

    turned: along axes of the cloud's own, those of its inertia, so that it comes out alike however it was turned.
    """
    points = np.asarray(points, np.float64)
    # The mean of the offsets from one point keeps the digits that a plain mean at an offset of 1e6 would lose.
    center = points[0] + (points - points[:1]).mean(axis=0)
    axes = _own_axes(points - center) if turned else np.eye(3)
    half_side = float(np.ptp((points - center) @ axes.T, axis=0).max()) / 2.0
    frame = Frame(center, half_side if half_side > 0.0 else 1.0, axes)
    return frame.from_input(points).astype(np.float32), frame


def knn(
    queries: Num[np.ndarray, "m 3"],
    points: Num[np.ndarray, "n 3"],
    point_mask: Bool[np.ndarray, "n"] | None = None,
    *,
    k: int,
    workers: int = -1,
) -> Neighbors:
    """The k nearest valid points to each query by a kd-tree, ordered by (distance, index).

    points[index[i, j]] is the j-th nearest to queries[i]; a query that is itself a point comes first, at distance 0.
    Where fewer than k points are valid, the remaining slots are padding as in Neighbors; count is the number of valid
    points. Distances are those of float64, so the order agrees with the float32 twin (geometry/neighbors.py) except
    where squared distances tie within 1e-6 relative. Points that tie exactly at the k-th place are chosen by lowest
    index as long as at most 64 points beyond it tie; beyond that (more than 64 copies of one point) any of them may
    stand there.

    Returns:
        Neighbors of NumPy arrays: index int32, sq_distance float64 in squared units of the cloud.
    """
    queries, points = np.asarray(queries, np.float64), np.asarray(points, np.float64)
    if point_mask is not None and not point_mask.all():
        rows = np.flatnonzero(point_mask)
        found = knn(queries, points[rows], k=k, workers=workers)
        return found if rows.size == 0 else found._replace(index=rows.astype(np.int32)[found.index])
    tree = KDTree(points, leafsize=16)
    # Queries in the order of the tree's leaves reuse what the cache holds: a third less time at 131,072 points.
    order = tree.indices if np.array_equal(queries, points) else np.arange(len(queries))
    index, distance = np.empty((len(queries), k), np.int64), np.empty((len(queries), k))
    index[order], distance[order] = _query(tree, queries[order], k=k, workers=workers)
    return _padded(index, np.square(distance), num_points=len(points))


def pca_normals(
    points: Num[np.ndarray, "n 3"], *, k: int, neighbors: Neighbors | None = None, workers: int = -1
) -> SurfaceNormals:
    """The direction of least spread among the k nearest neighbours of each point (itself included), and the curvature.

    Signs are arbitrary; a point whose neighbours coincide or lie on a line gets some unit vector perpendicular to
    the line. H. Hoppe et al. (1992); curvature as the "surface variation" of M. Pauly et al. (2002).

    Args:
        points: positions in any unit.
        k: neighbours per point, at least 3 to be of use; fewer points than k are used where the cloud is smaller.
        neighbors: those of the points, or of other places among them, if already known; k is then ignored.
        workers: threads of the search, -1 = all cores.
    """
    points = np.asarray(points, np.float64)
    found = knn(points, points, k=k, workers=workers) if neighbors is None else neighbors
    index, mask = np.asarray(found.index), np.asarray(found.mask)
    normal, curvature = np.empty((len(index), 3)), np.empty(len(index))

    def work(start: int) -> None:
        rows = slice(start, start + PCA_CHUNK)
        normal[rows], curvature[rows] = _least_spread(_covariances(points, index[rows], mask[rows]))

    with ThreadPoolExecutor(num_cores() if workers < 0 else workers) as pool:
        list(pool.map(work, range(0, len(index), PCA_CHUNK)))
    return SurfaceNormals(normal, curvature)


def build_hierarchy(
    points: Float32[np.ndarray, "n 3"],
    point_mask: Bool[np.ndarray, "n"] | None = None,
    *,
    spec: HierarchySpec,
    neighbors: Neighbors | None = None,
    workers: int = -1,
) -> Hierarchy:
    """The hierarchy of one cloud with kd-tree searches: faster than hierarchy.build on a CPU, for a loader to cache.

    The same arrays (as NumPy) as hierarchy.build gives, except where squared distances tie within 1e-6 relative.
    neighbors: those of the points among themselves, spec.own_neighbors(0) or more, if already known. workers: threads
    of the searches, -1 = all cores.
    """
    mask = np.ones(len(points), bool) if point_mask is None else point_mask
    with _on_cpu():
        sample, level_points, level_masks = jax.device_get(_sample_levels(points, mask, spec=spec))
        own, coarse = [], []
        for step in range(spec.num_steps):
            fine, fine_mask = level_points[step], level_masks[step]
            if step == 0 and neighbors is not None:
                own.append(nearest(neighbors, k=spec.own_neighbors(0)))
            else:
                own.append(knn(fine, fine, fine_mask, k=spec.own_neighbors(step), workers=workers))
            coarse.append(knn(fine, level_points[step + 1], level_masks[step + 1], k=NUM_INTERPOLATED, workers=workers))
        searches = Searches(sample, tuple(own), tuple(coarse))
        return jax.device_get(_assemble(points, mask, searches, spec=spec))


@partial(stored, static_argnames="spec")
def _sample_levels(
    points: Array, mask: Array, *, spec: HierarchySpec
) -> tuple[Array, tuple[Array, ...], tuple[Array, ...]]:
    """The farthest points of the cloud, and the points and masks of all levels."""
    sample = optimised_farthest_points(points, mask, num_samples=spec.num_points[0])
    return sample, *levels(points, mask, sample, spec=spec)[:2]


_assemble = stored(assemble, static_argnames="spec")


def orientation(vector: Float64[np.ndarray, "3"]) -> float:
    """The sign, 1 or -1, of the component of largest magnitude, as linalg.orientation."""
    return -1.0 if vector[np.argmax(np.abs(vector))] < 0.0 else 1.0


def frame_of(axis: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Right-handed frame with rows u, v and the unit axis, the same as linalg.frame_of."""
    x, y, z = axis.tolist()
    # The cross product with the direction of the smallest component, written out: np.cross takes ten times as long.
    smallest = min(abs(x), abs(y), abs(z))
    first = (0.0, z, -y) if abs(x) == smallest else (-z, 0.0, x) if abs(y) == smallest else (y, -x, 0.0)
    length = math.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2) or 1.0
    a, b, c = first[0] / length, first[1] / length, first[2] / length
    return np.array([[a, b, c], [y * c - z * b, z * a - x * c, x * b - y * a], [x, y, z]])


def _own_axes(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3 3"]:
    """A rotation whose rows are nearly the principal axes of points about their mean.

    What symmetry leaves open, the order of equal axes and all signs, the first rows decide: any choice will do that
    turns with the points.
    """
    size = float(np.abs(points).max())
    if size == 0.0:
        return np.eye(3)
    points = points / size
    first = points[:FIRST] * (0.5 ** np.arange(min(FIRST, len(points))))[:, None]
    inertia = points.T @ points / len(points) + TIE_BREAK * first.T @ first
    vectors = np.linalg.eigh(inertia)[1].T
    axes = vectors * np.where(vectors @ first.sum(axis=0) < 0.0, -1.0, 1.0)[:, None]
    return axes * np.linalg.det(axes).round()


def _on_cpu() -> contextlib.AbstractContextManager[Any]:
    """Keeps the small computations of a host build off the accelerator, where JAX has been given a CPU at all."""
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:
        return contextlib.nullcontext()


def _query(tree: KDTree, queries: Float64[np.ndarray, "m 3"], *, k: int, workers: int) -> tuple[np.ndarray, np.ndarray]:
    """(index, distance) of shape (m, k), ordered by (distance, index); tree.n and infinity where there is no point."""
    found: tuple[Any, Any] = tree.query(queries, k=k + 1, workers=workers)
    # In place j of a row: the j-th and the next neighbour lie equally far.
    equal = (found[0][:, 1:] == found[0][:, :-1]) & np.isfinite(found[0][:, :-1])
    distance, index = np.ascontiguousarray(found[0][:, :k]), np.ascontiguousarray(found[1][:, :k])
    tied = np.unique(np.flatnonzero(equal) // k)
    border = equal[tied, -1]
    rows = tied[~border]
    index[rows], distance[rows] = _sorted_ties(index[rows], distance[rows])
    tied = tied[border]
    for start in range(0, len(tied), CHUNK):
        rows = tied[start : start + CHUNK]
        found = tree.query(queries[rows], k=min(k + TIE_DEPTH, tree.n), workers=workers)
        more_index, more_distance = _sorted_ties(found[1], found[0])
        index[rows], distance[rows] = more_index[:, :k], more_distance[:, :k]
    return index, distance


def _sorted_ties(index: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows sorted by distance, put in order of (distance, index)."""
    order = np.lexsort((index, distance), axis=-1)
    return np.take_along_axis(index, order, axis=1), np.take_along_axis(distance, order, axis=1)


def _padded(index: np.ndarray, sq_distance: np.ndarray, *, num_points: int) -> Neighbors:
    """Neighbors from rows in which an index of num_points means that there is none."""
    mask = index < num_points
    index = np.where(mask, index, np.where(mask[:, :1], index[:, :1], 0)).astype(np.int32)
    sq_distance = np.where(mask, sq_distance, np.where(mask[:, :1], sq_distance[:, :1], 0.0))
    fields: tuple[Any, ...] = (index, sq_distance, mask, np.full(len(index), num_points, np.int32))
    return Neighbors(*fields)


def _covariances(points: Float64[np.ndarray, "n 3"], index: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(m, 3, 3) centred second moments (a mean, not a sum) of each row's neighbours, in two passes."""
    count, padded = np.maximum(mask.sum(axis=1), 1), not mask.all()
    offsets = []
    for coordinate in np.ascontiguousarray(points.T):
        # Offsets from the row's first neighbour are small numbers, whatever the position of the cloud.
        offset = coordinate.take(index)
        offset -= offset[:, :1]
        if padded:
            offset *= mask
        offset -= (offset.sum(axis=1) / count)[:, None]
        if padded:
            offset *= mask
        offsets.append(offset)
    covariance = np.empty((len(index), 3, 3))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        covariance[:, i, j] = covariance[:, j, i] = np.einsum("mk,mk->m", offsets[i], offsets[j]) / count
    return covariance


def _least_spread(covariance: Float64[np.ndarray, "m 3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Unit eigenvector of the smallest eigenvalue, and that eigenvalue over the trace.

    In closed form: the eigenvalue by the trigonometric solution of the cubic (O. Smith, 1961), the vector as the
    longest cross product of two rows of covariance - eigenvalue; three times faster than LAPACK on tiny matrices. Rows
    where the smallest eigenvalue is not simple, so that the cross products vanish, go to LAPACK.
    """
    trace = np.einsum("mcc->m", covariance)
    scaled = covariance / np.where(trace > 0.0, trace, 1.0)[:, None, None]
    deviator = scaled - np.eye(3)[None] * (np.einsum("mcc->m", scaled) / 3.0)[:, None, None]
    spread = np.sqrt(np.einsum("mij,mij->m", deviator, deviator) / 6.0)
    a, b, c = deviator[:, 0], deviator[:, 1], deviator[:, 2]
    determinant = np.einsum("mc,mc->m", a, np.cross(b, c))
    cosine = np.clip(determinant / np.where(spread > 0.0, 2.0 * spread**3, 1.0), -1.0, 1.0)
    smallest = 2.0 * spread * np.cos(np.arccos(cosine) / 3.0 + 2.0 * np.pi / 3.0)
    shifted = deviator - np.eye(3)[None] * smallest[:, None, None]
    a, b, c = shifted[:, 0], shifted[:, 1], shifted[:, 2]
    products = np.stack([np.cross(a, b), np.cross(b, c), np.cross(c, a)], axis=1)
    length = np.sqrt(np.einsum("mpc,mpc->mp", products, products))
    best = length.argmax(axis=1)
    rows = np.arange(len(best))
    length = length[rows, best]
    simple = length > 1e-6
    normal = products[rows, best] / np.where(simple, length, 1.0)[:, None]
    normal[~simple] = np.linalg.eigh(scaled[~simple])[1][:, :, 0]
    rayleigh = np.einsum("mi,mij,mj->m", normal, scaled, normal)
    return normal, np.clip(rayleigh, 0.0, 1.0 / 3.0)
