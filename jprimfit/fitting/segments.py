"""Points, weights and normals of one segment as they come from a caller: checked, and brought to unit scale in float64.

Whatever is no segment is refused in one sentence. NumPy only. n points.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

MAX_MAGNITUDE = 1e100  # of a coordinate: beyond, squares leave float64
FAR = 1e-3  # of the distance from the origin: the extent of a segment that lies far from it
MIN_WEIGHT = 1e-12  # of the largest: less counts as none


class Segment(NamedTuple):
    """The m points of a segment that have weight, at unit scale: points = anchor + size * local."""

    local: Float[np.ndarray, "m 3"]  # weighted mean 0, rms distance from it 1; its columns lie whole in memory
    weights: Float[np.ndarray, " m"]  # in (0, 1], the largest 1
    normals: Float[np.ndarray, "m 3"] | None  # of any length
    anchor: Float[np.ndarray, "3"]
    size: float  # 0 where there is none: no weight, or all points equal


def segment(points: Any, weights: Any = None, normals: Any = None) -> Segment:
    """The segment, or a ValueError of one sentence that says what was given instead."""
    points = _numbers(points, "points", 3)
    if len(points) == 0:
        raise ValueError("points has no rows: give at least one point.")
    count = len(points)
    normals = None if normals is None else _numbers(normals, "normals", 3)
    if normals is not None and len(normals) != count:
        raise ValueError(f"normals has {len(normals)} rows and points {count}: give one normal per point.")
    if weights is None:
        weights = np.ones(count)
    else:
        weights = _numbers(weights, "weights", None)
        if len(weights) != count:
            raise ValueError(f"weights has {len(weights)} values and points {count} rows: give one weight per point.")
        if weights.min() < 0.0:
            raise ValueError(f"weights holds {weights.min():g}, but none may be negative.")
        counted = weights > MIN_WEIGHT * weights.max()
        if not counted.any():
            return Segment(points[:0], weights[:0], None, points[0] + (points - points[0]).mean(axis=0), 0.0)
        points, weights, normals = points[counted], weights[counted], None if normals is None else normals[counted]
        weights /= weights.max()
    # Row by row, NumPy would take three numbers at a time; and fresh memory costs more than the sums: hence in place.
    local = np.array(points.T, order="C")
    total = weights.sum()
    anchor = local @ weights / total
    local -= anchor[:, None]
    largest = float(max(local.max(), -local.min()))
    if largest < FAR * np.abs(anchor).max():  # the mean's rounding would show
        rest = local @ weights / total
        anchor += rest
        local -= rest[:, None]
        largest = float(max(local.max(), -local.min()))
    # What is left of equal points after the subtraction is rounding.
    if largest <= 8.0 * np.finfo(float).eps * float(np.abs(anchor).max()):
        return Segment(points, weights, None, anchor, 0.0)
    local /= largest
    size = float(np.sqrt(np.einsum("cn,cn,n->", local, local, weights) / total))
    local /= size
    return Segment(local.T, weights, normals, anchor, largest * size)


def unit(normals: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """The normals at length 1; one of length 0 stays."""
    normals = normals / np.maximum(np.abs(normals).max(axis=1, keepdims=True), 1e-300)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def _numbers(value: Any, name: str, width: int | None) -> np.ndarray:
    shape = "(n,)" if width is None else f"(n, {width})"
    try:
        array = np.asarray(value)
    except Exception as error:  # whatever an object's own conversion raises
        raise ValueError(f"{name} is no array ({type(error).__name__}): give numbers of shape {shape}.") from None
    expected = array.ndim == 1 if width is None else array.ndim == 2 and array.shape[1] == width
    if array.dtype.kind not in "fiu" or not expected:
        raise ValueError(f"{name} has shape {array.shape} and type {array.dtype}: give real numbers of shape {shape}.")
    array = array.astype(np.float64, copy=False)
    if array.size and not (array.max() <= MAX_MAGNITUDE and array.min() >= -MAX_MAGNITUDE):
        raise ValueError(f"{name} holds NaN, infinities or values beyond {MAX_MAGNITUDE:g}: leave such rows out.")
    return array
