"""Everything about a cloud that needs a search, found on the host: what a network is given beside the coordinates.

The same for a cloud of the training pool and for a scan at inference. One search for the largest neighbourhood serves
all: neighbours come in order of distance, so that the smaller ones are its first columns. Letters: n points, g sizes of
neighbourhood. Lengths in the unit of the points; a HierarchySpec means its own in the normalised frame.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float32, Num

from jprimfit.geometry import hierarchy
from jprimfit.geometry.filtering import FILTERED, bilateral_normals
from jprimfit.geometry.hierarchy import HierarchySpec, IndexSets, index_sets, nearest
from jprimfit.geometry.host import build_hierarchy, knn, pca_normals
from jprimfit.types import Neighbors


class Prepared(NamedTuple):
    """A cloud ready for a network; fields as in data/examples.Example."""

    points: Float32[np.ndarray, "n 3"]
    mask: Bool[np.ndarray, "n"]  # False = padding, behind the points: a copy of the first
    local_normals: Float32[np.ndarray, "n g 3"]  # unit, of PCA at g sizes of neighbourhood or filtered, of either sign
    curvature: Float32[np.ndarray, "n g"]  # the surface variation of the same neighbourhoods, in [0, 1/3]
    sets: IndexSets


def prepare(
    points: Num[np.ndarray, "m 3"],
    *,
    spec: HierarchySpec,
    neighborhoods: tuple[int, ...],
    num_points: int | None = None,
    workers: int = -1,
) -> Prepared:
    """Neighbours, PCA normals and index sets of 1 <= m <= num_points points, padded to num_points.

    Args:
        points: all valid, in the normalised frame.
        spec: sizes of the hierarchy.
        neighborhoods: k of each PCA normal, itself included; may be empty. FILTERED (0) stands for the normals of the
            smallest, filtered over the largest.
        num_points: n of the result; the number of points if None.
        workers: threads of the searches, -1 = all cores.

    Raises:
        ValueError: no points, more than num_points of them, or neighbourhoods that are none of three points or more.
    """
    points = np.asarray(points, np.float32)
    size = len(points) if num_points is None else num_points
    if not 1 <= len(points) <= size:
        raise ValueError(f"The cloud has {len(points)} points, expected 1 to {size}; thin it first.")
    sizes = [k for k in neighborhoods if k != FILTERED]
    if min(sizes, default=0 if neighborhoods else 3) < 3:
        raise ValueError(f"The neighbourhoods are {neighborhoods}, expected at least 3 points in each.")
    found = knn(points, points, k=max(spec.own_neighbors(0), *sizes, 1), workers=workers)
    surfaces: dict[int, Any] = {k: pca_normals(points, k=k, neighbors=nearest(found, k=k)) for k in sizes}
    if FILTERED in neighborhoods:
        normal, curvature = (values.astype(np.float32) for values in surfaces[min(sizes)])
        surfaces[FILTERED] = bilateral_normals(points, normal, curvature, nearest(found, k=max(sizes)))
    local_normals = np.zeros((len(points), len(neighborhoods), 3), np.float32)
    curvature = np.zeros((len(points), len(neighborhoods)), np.float32)
    for column, k in enumerate(neighborhoods):
        local_normals[:, column], curvature[:, column] = surfaces[k].normal, surfaces[k].curvature
    padded, mask = _padded(points, size), np.arange(size) < len(points)
    own = Neighbors(*(_padded(values, size) for values in found))
    built = build_hierarchy(padded, mask, spec=spec, neighbors=own, workers=workers)
    return Prepared(padded, mask, _padded(local_normals, size), _padded(curvature, size), index_sets(built))


def layout(*, spec: HierarchySpec, neighborhoods: tuple[int, ...], num_points: int) -> Prepared:
    """Shapes and types of what `prepare` gives, as jax.ShapeDtypeStructs."""
    sizes = (num_points, len(neighborhoods))
    fields: tuple[Any, ...] = (
        jax.ShapeDtypeStruct((num_points, 3), np.float32),
        jax.ShapeDtypeStruct((num_points,), np.bool_),
        jax.ShapeDtypeStruct((*sizes, 3), np.float32),
        jax.ShapeDtypeStruct(sizes, np.float32),
        hierarchy.layout(num_points, spec=spec),
    )
    return Prepared(*fields)


def _padded(rows: np.ndarray, size: int) -> np.ndarray:
    """The rows, then copies of the first."""
    return np.concatenate([rows, np.repeat(rows[:1], size - len(rows), axis=0)])
