"""From where a part is shown: upright, from outside, in the three-quarter view that shows the most of it.

All three are read from the points rather than from the segments, so that another segmentation hardly moves the camera.
Upright: the axis that most of the surface is square or parallel to, as with plates, tables and lathe work; the z axis
where that will do. Outside: the side of a surface that more of the tried views see. The two sides of a plate whose
underside was not scanned are alike in that; the bosses and balls on it are not. Letters: n points, d directions, c
candidates.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from jprimfit.geometry import host
from jprimfit.io import raster

AZIMUTHS = np.deg2rad(np.arange(0, 360, 30))
ELEVATION = np.deg2rad(32.0)
UPSIDE_DOWN = 0.9  # what a view counts in which z points down
HANGING = 0.25  # what a view counts in which things hang from a table
ONE_SIDED = 0.75  # share of the points that can be seen at once; a scan all around shows half of them
MAX_POINTS = 12_000
SHAPE = (96, 112)  # of the trial pictures
NEIGHBORS = 32  # of a normal
COVER = 2.6  # reach of what hides others, in mean distances of points
NEARLY = 0.2  # sine of the angle below which directions count as parallel or square
SQUARE = 0.5  # what a surface square to an axis counts, beside one that is parallel to its plane
NUM_TRIED = 300  # normals that an axis is chosen from, and as many pairs of them
FAMILIAR = 0.6  # a coordinate axis will do that scores this part of the best one
SURE = 1.5  # how fast one side's advantage makes it the outside: at 1/3 of all that is seen
CROWD = 0.75  # power of what is seen of a segment
SNAP = np.deg2rad(4.0)  # from a coordinate axis is as good as along it
STRAY = np.deg2rad(30.0)  # is too far from an axis to be its refinement: few normals say nothing
MIN_SHARE = 0.01  # of the points; smaller segments count together


class Viewpoint(NamedTuple):
    """Unit vectors, in the frame of the points."""

    back: Float[np.ndarray, "3"]  # from the part to the viewer
    up: Float[np.ndarray, "3"]


class _Trials(NamedTuple):
    """What d directions show."""

    back: Float[np.ndarray, "d 3"]
    up: Float[np.ndarray, "d 3"]
    visible: Bool[np.ndarray, "d n"]
    whole: Float[np.ndarray, "d"]  # share of the outline that is not gaps


def choose(points: Float[np.ndarray, "n 3"], labels: Int[np.ndarray, "n"]) -> Viewpoint:
    """The viewpoint that shows most of most segments from outside, and the fewest gaps.

    Args:
        points: of the scan; MAX_POINTS of them suffice.
        labels: segment of each point, -1 for none.
    """
    near = host.knn(points, points, k=min(NEIGHBORS, len(points)))
    normals = host.pca_normals(points, k=NEIGHBORS, neighbors=near).normal
    # Half a neighbourhood away: as many points lie within a disc of that radius.
    middle = near.sq_distance.shape[1] // 2
    spread = float(np.sqrt(np.median(near.sq_distance[:, middle]) * np.pi / max(middle, 1)))
    up = _axis(normals, np.eye(3)[[2, 0, 1]])
    level = normals - (normals @ up)[:, None] * up[None, :]
    level = level[np.einsum("nd,nd->n", level, level) > 1 - NEARLY**2]
    side = _axis(level, np.eye(3), around=up)
    trials = _look(points, up, side, cover=COVER * spread)
    score = _weighed(_outsides(normals, trials), labels) * trials.whole**2 * _welcome(points, up, trials)
    best = int(np.argmax(np.round(score / max(score.max(), 1e-12), 6)))
    return Viewpoint(trials.back[best], trials.up[best])


def _outsides(normals: Float[np.ndarray, "n 3"], trials: _Trials) -> Float[np.ndarray, "d n"]:
    """How large each point appears in each view, 0 where it is hidden or seen from inside, half where nobody knows."""
    facing = np.einsum("dc,nc->dn", trials.back, normals)
    seen = np.where(trials.visible, facing, 0.0)
    # How much more it is seen from before its normal than from behind it, in [-1, 1].
    before = seen.sum(axis=0) / np.maximum(np.abs(seen).sum(axis=0), 1e-9)
    return np.abs(seen) * np.clip(0.5 + SURE * before[None, :] * np.sign(facing), 0.0, 1.0)


def _weighed(shown: Float[np.ndarray, "d n"], labels: Int[np.ndarray, "n"]) -> Float[np.ndarray, "d"]:
    """The sum over segments of a power of what is shown of them: many count more than one large one."""
    _, segment, counts = np.unique(labels, return_inverse=True, return_counts=True)
    segment = np.where(counts[segment] < MIN_SHARE * len(labels), len(counts), segment)
    return np.array([(np.bincount(segment, weights) ** CROWD).sum() for weights in shown])


def _welcome(points: np.ndarray, up: np.ndarray, trials: _Trials) -> Float[np.ndarray, "d"]:
    """What the views count for their direction alone."""
    share = trials.visible.mean(axis=1)
    if share.max() < ONE_SIDED:
        return np.where(trials.up[:, 2] < -1 + NEARLY**2, UPSIDE_DOWN, 1.0)
    # Taken from one place, from where it hides nothing. That holds from the back as well; but things stand on a table,
    # they do not hang from it, so the long tail of the heights is up.
    height = points @ up
    end = 1.0 if height.mean() >= np.median(height) else -1.0
    return share**8 * np.where(trials.up @ up * end > 0, 1.0, HANGING)


def _look(points: np.ndarray, up: np.ndarray, side: np.ndarray, *, cover: float) -> _Trials:
    """The three-quarter views around an axis, with either end of it up."""
    backs, ups, visible, whole = [], [], [], []
    other = np.cross(up, side)
    for end in (up, -up):
        for azimuth in AZIMUTHS:
            level = np.cos(azimuth) * side + np.sin(azimuth) * other
            back = np.cos(ELEVATION) * level + np.sin(ELEVATION) * end
            view = raster.camera(points, back=back, up=end, shape=SHAPE)
            screen = raster.project(view, points)
            covered = raster.splat(view, screen, radius=1.5).item >= 0
            filled: Any = ndimage.binary_fill_holes(covered)
            whole.append(covered.sum() / max(filled.sum(), 1))
            visible.append(raster.visible(view, screen, cover=cover))
            backs.append(back)
            ups.append(end)
    return _Trials(np.array(backs), np.array(ups), np.array(visible), np.array(whole))


def _axis(
    normals: Float[np.ndarray, "n 3"], familiar: Float[np.ndarray, "3 3"], around: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "3"]:
    """The axis that most normals are parallel or square to, tried in the order of `familiar`, square to `around`."""
    step = max(len(normals) // NUM_TRIED, 1)
    tried = normals[::step][:NUM_TRIED]
    pairs = np.cross(tried, np.roll(tried, len(tried) // 2, axis=0))
    found = np.concatenate([familiar, tried, pairs])
    if around is not None:
        found = found - (found @ around)[:, None] * around[None, :]
    size = np.sqrt(np.einsum("cd,cd->c", found, found))
    usable = size > 0.5
    found = found[usable] / size[usable, None]
    cosine = np.abs(found @ normals.T)
    parallel, square = cosine > 1 - NEARLY**2 / 2, cosine < NEARLY
    score = parallel.sum(axis=1) + SQUARE * square.sum(axis=1)
    good = np.flatnonzero(score[: usable[:3].sum()] >= FAMILIAR * score.max(initial=0))
    best = int(good[0] if len(good) else np.argmax(score))
    # Refined: as parallel to the ones and as square to the others as can be, in the sense of least squares.
    ones, others = normals[parallel[best]], normals[square[best]]
    agreement = ones.T @ ones - SQUARE * others.T @ others
    if around is not None:
        agreement -= 2 * len(normals) * np.outer(around, around)
    axis = np.linalg.eigh(agreement)[1][:, -1]
    turned = float(np.arccos(min(np.abs(axis @ found[best]), 1.0)))
    if (len(good) and turned < SNAP) or turned > STRAY:
        return found[best]
    return axis * host.orientation(axis)
