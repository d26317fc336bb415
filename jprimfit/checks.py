"""Whether an array can be a scan: what `jprimfit.fit` demands of its points before anything is computed.

Rows that hold NaN, infinities or absurd magnitudes are dropped and the map to the input's rows kept; arrays from which
no surface can follow (too few distinct points, all on one line) are refused in one sentence. NumPy only, float64.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

# Beyond this, squares of coordinates leave float64.
MAX_MAGNITUDE = 1e100
MIN_DISTINCT = 4
# Width over length below which points count as collinear: covariances in float64 resolve about 1e-8.
MIN_WIDTH = 1e-6


class Usable(NamedTuple):
    """The rows of a scan that can be worked with: points[i] is row rows[i] of the input."""

    points: Float[np.ndarray, "m 3"]  # float64, unit and frame of the input
    normals: Float[np.ndarray, "m 3"] | None  # float64, unit length; None if not given or one of them has no direction
    rows: Int[np.ndarray, "m"]  # int64, increasing


def usable_rows(points: Any, normals: Any = None) -> Usable:
    """The rows whose three coordinates are finite numbers, or a ValueError of one sentence if they span no surface.

    Dropped are rows with NaN, an infinity or a coordinate beyond 1e100. Normals that came with the points are scaled to
    length 1; where one of a usable row is zero or not finite all of them are left out, to be estimated instead.
    """
    array = _numbers(points, "points")
    usable = np.all(np.abs(array) <= MAX_MAGNITUDE, axis=1)  # False for NaN
    rows = np.flatnonzero(usable)
    num_dropped = len(array) - len(rows)
    array = array[rows]
    _refuse_degenerate(array, num_dropped)
    if normals is None:
        return Usable(array, None, rows)
    directions = _numbers(normals, "normals")
    if len(directions) != len(usable):
        raise ValueError(
            f"normals has {len(directions)} rows and points {len(usable)}: give one normal per point, or none at all."
        )
    return Usable(array, _unit(directions[rows]), rows)


def usable_labels(labels: Any, num_points: int) -> Int[np.ndarray, "n"]:
    """The segment of each point as int64, or a ValueError of one sentence."""
    try:
        array = np.asarray(labels)
    except Exception as error:  # whatever an object's own conversion raises
        raise ValueError(f"labels is no array ({type(error).__name__}): give one integer per point.") from None
    if array.dtype.kind not in "iu" or array.shape != (num_points,):
        raise ValueError(
            f"labels has shape {array.shape} and type {array.dtype}: give one integer for each of {num_points} points."
        )
    if not np.any(array >= 0):
        raise ValueError("labels names no segment: give the points of a segment a number of 0 or more.")
    return array.astype(np.int64)


def chosen_kinds(kinds: Any, known: Sequence[str]) -> tuple[str, ...]:
    """The kinds in the order of the known ones, or a ValueError of one sentence."""
    chosen = [kinds] if isinstance(kinds, str) else list(kinds)
    wrong = [kind for kind in chosen if kind not in known]
    if wrong or not chosen:
        raise ValueError(f"kinds is {chosen}, but some of {', '.join(known)} are expected.")
    return tuple(kind for kind in known if kind in chosen)


def told_kinds(kind_of: Mapping[int, str] | None, labels: Int[np.ndarray, "n"], known: Sequence[str]) -> dict[int, str]:
    """The kind of some labels, or a ValueError of one sentence."""
    present = set(np.unique(labels).tolist())
    for label, kind in (kind_of or {}).items():
        if kind not in known:
            raise ValueError(f"kind_of makes label {label} a {kind!r}, but {', '.join(known)} are the kinds there are.")
        if label not in present or label < 0:
            raise ValueError(f"kind_of tells the kind of label {label}, which no point has.")
    return dict(kind_of or {})


def positive(value: Any, name: str) -> float | None:
    """A finite number above 0, or None as given; else a ValueError of one sentence."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not 0 < value < np.inf:
        raise ValueError(f"{name} is {value!r}, but a length above 0 is expected.")
    return float(value)


def count(value: Any, name: str) -> int:
    """A whole number of 1 or more; else a ValueError of one sentence."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name} is {value!r}, but a whole number of 1 or more is expected.")
    return int(value)


def _numbers(value: Any, name: str) -> Float[np.ndarray, "n 3"]:
    """The value as float64 (n, 3), or a ValueError that says what it is instead."""
    try:
        array = np.asarray(value)
    except Exception as error:  # whatever an object's own conversion raises
        raise ValueError(f"{name} is no array ({type(error).__name__}): give numbers of shape (n, 3).") from None
    if array.dtype.kind not in "fiu":
        raise ValueError(
            f"{name} holds values of type {array.dtype}, but real numbers are expected: give shape (n, 3)."
        )
    if array.size == 0:
        raise ValueError(f"{name} is empty (shape {array.shape}): give at least {MIN_DISTINCT} rows of x y z.")
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} has shape {array.shape}, but (n, 3) is expected: give one row of x y z per point.")
    return array.astype(np.float64)


def _refuse_degenerate(points: Float[np.ndarray, "m 3"], num_dropped: int) -> None:
    dropped = f" after dropping {num_dropped} rows that are not finite" if num_dropped else ""
    num_distinct = _count_distinct(points, MIN_DISTINCT)
    if num_distinct < MIN_DISTINCT:
        what = f"{len(points)} point{'s' if len(points) != 1 else ''}, {num_distinct} of them distinct"
        raise ValueError(f"the scan has {what}{dropped}: at least {MIN_DISTINCT} distinct points are needed.")
    # Scaled by the largest coordinate difference, so that neither 1e-160 nor 1e90 leaves float64 when squared.
    extent = np.max(points.max(axis=0) - points.min(axis=0))
    centered = (points - points.mean(axis=0)[None, :]) / extent
    width, length = np.sqrt(np.maximum(np.linalg.eigvalsh(centered.T @ centered / len(points))[1:], 0.0))
    rounding = 8 * np.finfo(np.float64).eps * np.max(np.abs(points)) / extent
    if width <= MIN_WIDTH * length + rounding:
        raise ValueError(f"all {len(points)} points lie on one line{dropped}: give a scan that covers a surface.")


def _count_distinct(points: Float[np.ndarray, "m 3"], cap: int) -> int:
    """The number of distinct rows, up to `cap`; a pass per distinct row rather than a sort."""
    unseen: Bool[np.ndarray, "m"] = np.ones(len(points), bool)
    for count in range(cap):
        if not unseen.any():
            return count
        unseen &= np.any(points != points[np.argmax(unseen)][None, :], axis=1)
    return cap


def _unit(normals: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"] | None:
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.sqrt(np.sum(normals**2, axis=1))
    if not np.all((length > 0) & (length < np.inf)):
        return None
    return normals / length[:, None]
