"""From a raw scan to the cloud that the method works on (paper, section 4): filter, smooth, normalise, down-sample.

Every step keeps the map to the input: row j of the result is row index[j] of the scan. What was removed is listed and
reported, nothing is dropped silently. The scan is float64 in any unit and position; the result is float32 in the
normalised frame of what the filter left (centroid at 0, along axes of its own, longest side of the box 2), rounded to
multiples of STEP: what the unit, the position and the turn of a scan leave in the last digits of its coordinates must
not decide where surfaces end.
"""

import time
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Int32, Num

from jprimfit.geometry import host
from jprimfit.preprocessing.downsampling import downsample
from jprimfit.preprocessing.outliers import Mode, find_outliers
from jprimfit.preprocessing.smoothing import gaussian_smooth

STEP = 2.0**-20  # of coordinates in the normalised frame: half a millionth of the scan


class Preprocessed(NamedTuple):
    """A scan made ready, and how it relates to the n points of the input."""

    points: Float32[np.ndarray, "m 3"]  # normalised frame
    frame: host.Frame  # leads back to the input's unit and position
    index: Int32[np.ndarray, "m"]  # points[j] comes from row index[j] of the input
    removed: Int32[np.ndarray, "r"]  # rows of the input removed as outliers, ascending
    report: dict[str, Any]  # what each step did, ready for JSON
    neighbors: Int32[np.ndarray, "n k"] | None  # of every point by distance, itself first, where they came to be known


def preprocess(
    points: Num[np.ndarray, "n 3"],
    *,
    filter: Mode = "auto",
    smooth: bool = False,
    max_points: int = 10_000,
    num_points: int = 8192,
) -> Preprocessed:
    """Outlier filter, smoothing, normalisation and down-sampling of a scan of n >= 1 finite points.

    Args:
        points: the scan, in any unit and position; float64 keeps the digits of one far from the origin.
        filter: "on" always filters, "off" never, "auto" only a scan with isolated points (preprocessing/outliers).
        smooth: replaces each point by a Gaussian mean of its neighbours; the frame stays that of the raw points.
        max_points: a cloud with more points than this after the filter is down-sampled.
        num_points: to this number.
    """
    points = np.asarray(points, np.float64)
    start = time.perf_counter()
    outliers = find_outliers(points, mode=filter)
    kept = np.flatnonzero(outliers.keep)
    seconds = {"filter": time.perf_counter() - start}

    normalised, frame = host.normalize(points[kept], turned=True)
    if smooth:
        start = time.perf_counter()
        normalised = frame.from_input(gaussian_smooth(points[kept])).astype(np.float32)
        seconds["smooth"] = time.perf_counter() - start

    start = time.perf_counter()
    normalised = (np.round(normalised.astype(np.float64) / STEP) * STEP).astype(np.float32)
    rows = downsample(normalised, max_points=max_points, num_points=num_points)
    seconds["downsample"] = time.perf_counter() - start
    report = {
        "num_input": len(points),
        "num_removed": len(points) - len(kept),
        "num_output": len(rows),
        "filter": {
            "mode": filter,
            "passes": len(outliers.thresholds),
            "thresholds": [float(threshold) for threshold in outliers.thresholds if np.isfinite(threshold)],
            "isolated_share": outliers.isolated_share,
        },
        "smoothed": smooth,
        "downsampled": len(rows) < len(kept),
        "frame": {"center": frame.center.tolist(), "scale": frame.scale, "axes": frame.axes.tolist()},
        "seconds": {name: round(value, 4) for name, value in seconds.items()},
    }
    removed = np.flatnonzero(~outliers.keep).astype(np.int32)
    return Preprocessed(normalised[rows], frame, kept[rows].astype(np.int32), removed, report, outliers.neighbors)


def nearest_rows(from_points: Num[np.ndarray, "m 3"], to_points: Num[np.ndarray, "n 3"]) -> Int32[np.ndarray, " n"]:
    """The row of the nearest of from_points for each of to_points; clouds in one frame, m >= 1.

    values[rows] carries labels or normals of a down-sampled cloud back to the whole one.
    """
    return np.asarray(host.knn(to_points, from_points, k=1).index)[:, 0]
