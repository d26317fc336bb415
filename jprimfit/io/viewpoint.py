"""From where a part is shown: which way is up, and the three-quarter view that shows the most of its surfaces.

Up is the z axis, unless one plane carries more than a third of the points: the part then lies on it, as a plate or a
table scene does, whatever the axes of the sensor. Directions are tried all around and compared by what they show.
Letters: n points, d directions.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from jprimfit.io import raster

AZIMUTHS = np.deg2rad(np.array([-60, -30, 30, 60, 120, 150, 210, 240]))
ELEVATIONS = ((32.0, 1.0), (18.0, 0.93), (-25.0, 0.75))  # degrees, and how welcome they are
LYING = 0.35  # share of the points above which a plane is what the part lies on
MAX_POINTS = 12_000
SHAPE = (84, 96)  # of the trial pictures
INSIDE = 0.5  # what a pixel counts that shows a sphere, cylinder or cone from its inner side


class Viewpoint(NamedTuple):
    """Unit vectors, in the frame of the points."""

    back: Float[np.ndarray, "3"]  # from the part to the viewer
    up: Float[np.ndarray, "3"]


def choose(
    points: Float[np.ndarray, "n 3"],
    labels: Int[np.ndarray, "n"],
    kinds: Sequence[str],
    normals: Float[np.ndarray, "n 3"],
) -> Viewpoint:
    """The viewpoint that shows the most segments, outsides before insides, and from above rather than from below.

    Args:
        points: of the scan; MAX_POINTS of them suffice.
        labels: index into kinds, or -1.
        kinds: of the primitives.
        normals: of the fitted surfaces at the points (away from centre or axis where kinds are round), zero for -1.
    """
    round_kinds = np.array([kind != "plane" for kind in kinds] + [False])[labels]
    up = _up(points, labels, kinds, normals)
    side = np.eye(3)[np.argmin(np.abs(up) + np.array([0.0, 0.02, 0.04]))]
    side = side - (side @ up) * up
    side = side / np.sqrt(side @ side)
    other = np.cross(up, side)
    best, best_score = up, -np.inf
    for elevation, welcome in ELEVATIONS:
        for azimuth in AZIMUTHS:
            level = np.cos(azimuth) * side + np.sin(azimuth) * other
            back = np.cos(np.deg2rad(elevation)) * level + np.sin(np.deg2rad(elevation)) * up
            score = welcome * _score(points, labels, np.where(round_kinds[:, None], normals, 0.0), back, up)
            if score > best_score * (1 + 1e-6):
                best, best_score = back, score
    return Viewpoint(best, up)


def _score(points: np.ndarray, labels: np.ndarray, outward: np.ndarray, back: np.ndarray, up: np.ndarray) -> float:
    """Sum over segments of the root of the pixels that show it (many count more than one large one), less for holes."""
    view = raster.camera(points, back=back, up=up, shape=SHAPE)
    seen = raster.splat(view, raster.project(view, points), radius=1.5).item
    item = seen[seen >= 0]
    weight = np.where(outward[item] @ back < -0.05, INSIDE, 1.0)
    # A scan taken from one side is whole from there and full of shadows from elsewhere.
    filled: Any = ndimage.binary_fill_holes(seen >= 0)
    whole = len(item) / max(int(filled.sum()), 1)
    return float(np.sqrt(np.bincount(labels[item] + 1, weight)).sum()) * whole**2


def _up(points: np.ndarray, labels: np.ndarray, kinds: Sequence[str], normals: np.ndarray) -> np.ndarray:
    """The z axis, or the normal of the plane that the part lies on, on the side where the rest of the points is."""
    up = np.array([0.0, 0.0, 1.0])
    counts = np.bincount(labels[labels >= 0], minlength=len(kinds))
    counts = np.where([kind == "plane" for kind in kinds], counts, 0) if kinds else counts
    if len(counts) == 0 or counts.max() < LYING * len(points):
        return up
    ground = labels == int(np.argmax(counts))
    normal = normals[ground].mean(axis=0)
    length = np.sqrt(normal @ normal)
    if length < 0.5:
        return up
    normal = normal / length
    height = (points - points[ground].mean(axis=0)[None, :]) @ normal
    above, below = np.sum(height[~ground] > 0), np.sum(height[~ground] < 0)
    if max(above, below) > 1.5 * min(above, below):
        return normal if above > below else -normal
    return normal if normal @ up >= 0 else -normal
