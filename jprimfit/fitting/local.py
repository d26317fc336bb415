"""What the neighbourhood of each point says of the surface there: normal, noise, and whether it is one smooth surface.

A quadric z = a + b x + c y + d x^2 + e xy + f y^2 over the tangent plane of k neighbours follows every one of our
surfaces to third order, so what it leaves over is noise, or an edge. From the quiet share of these residuals comes the
noise of the scan, from the noise the number of neighbours that a normal needs, and from both the "core": points whose
neighbourhood is one smooth surface. Only core points may carry growth across the cloud; the others lie on edges.
Host code in float64 (NumPy); lengths in the unit of the cloud. n points, k neighbours.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import gammaincinv

from jprimfit.cores import num_cores
from jprimfit.geometry import host
from jprimfit.types import Neighbors

QUADRIC_NEIGHBORS = 13  # 6 unknowns, 7 left over to tell noise from shape
# Quantiles of the residuals that the noise is read from: the points of smooth surface, and the quietest of them.
QUIET, QUIETEST = 0.3, 0.1
NOISE_SAMPLE = 2_048  # points at which the noise is measured again over wider neighbourhoods
FIRST_WIDENING = 1.35  # times the noise, at most: a plane under noise of three times the spacing reads 1.24
CHUNK = 4_096  # points of a pass, small enough for the cache


class LocalSurface(NamedTuple):
    """The cloud seen point by point."""

    index: Int[np.ndarray, "n k"]  # neighbours by distance, the point itself first
    normal: Float[np.ndarray, "n 3"]  # unit, of either sign
    residual: Float[np.ndarray, " n"]  # rms distance of the neighbours to the local quadric, length
    core: Bool[np.ndarray, " n"]  # True = the neighbourhood is one smooth surface
    spacing: float  # median distance to the nearest other point, length
    noise: float  # standard deviation along the normal, length

    def num_in_disk(self, radius: float) -> float:
        """Points of a surface in a disk on it: half of all points at random have none nearer than the spacing."""
        return float(np.log(2.0)) * (radius / self.spacing) ** 2


def describe(
    points: Float[np.ndarray, "n 3"],
    *,
    normals: Float[np.ndarray, "n 3"] | None = None,
    noise: float | None = None,
    spacing: float | None = None,
    narrow: bool = False,
) -> LocalSurface:
    """Local quadrics, noise and normals of a cloud of n >= 4 points.

    normals: measured ones, taken instead of estimates. noise, spacing: those of the cloud that the points are the rest
    of, where they are known better. narrow: the neighbours of a clean cloud will do, where normals were measured.
    """
    neighbors = host.knn(points, points, k=min(QUADRIC_NEIGHBORS, len(points)))
    spacing = _spacing(points, np.sqrt(neighbors.sq_distance)) if spacing is None else spacing
    normal, residual = _quadrics(points, neighbors)
    index = np.asarray(neighbors.index)
    noise = _noise(points, residual, spacing) if noise is None else noise
    ratio = noise / spacing
    if ratio > 0.05 and not (narrow and normals is not None):
        # The angle error of a plane's normal is about 2 noise / (spacing k): keep it near 5 degrees.
        k = int(np.clip(12 + 40 * ratio, 16, 80))
        wide = host.knn(points, points, k=min(k, len(points)))
        normal = host.pca_normals(points, k=k, neighbors=wide).normal if normals is None else normal
        index = np.asarray(wide.index)
    normal = normal if normals is None else normals
    return LocalSurface(index, normal, residual, _is_core(residual, spacing, noise), spacing, noise)


def under_noise(surface: LocalSurface, noise: float) -> LocalSurface:
    """The same cloud where its noise turns out to be another."""
    return surface._replace(noise=noise, core=_is_core(surface.residual, surface.spacing, noise))


def of_all(
    sample: LocalSurface,
    nearest: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "n 3"],
    *,
    normals: Float[np.ndarray, "n 3"] | None = None,
    index: Int[np.ndarray, "n k"] | None = None,
) -> LocalSurface:
    """All points of a noisy cloud as the nearest ones of a sample were described; neighbours and spacing are their own.

    normals, index: of all points, measured or known; else the sample's, and the QUADRIC_NEIGHBORS nearest.
    """
    if index is None:
        index = np.asarray(host.knn(points, points, k=min(QUADRIC_NEIGHBORS, len(points))).index)
    spacing = float(np.median(np.sqrt(np.square(points[index[:, 1]] - points).sum(axis=1))))
    normals = sample.normal[nearest] if normals is None else normals
    return LocalSurface(index, normals, sample.residual[nearest], sample.core[nearest], spacing, sample.noise)


def _is_core(residual: Float[np.ndarray, " n"], spacing: float, noise: float) -> Bool[np.ndarray, " n"]:
    return residual <= max(2.0 * noise, 0.03 * spacing)


def _spacing(points: Float[np.ndarray, "n 3"], distance: Float[np.ndarray, "n k"]) -> float:
    """Median distance to the nearest point elsewhere; copies of a point, which some scanners write, do not count."""
    apart = np.where(distance > 0, distance, np.inf).min(axis=1)
    if np.isfinite(apart).any():
        return float(np.median(apart[np.isfinite(apart)]))
    distinct = np.unique(points, axis=0)
    return float(np.median(np.sqrt(host.knn(distinct, distinct, k=2).sq_distance[:, 1])))


def _noise(points: Float[np.ndarray, "n 3"], residual: Float[np.ndarray, " n"], spacing: float) -> float:
    """Standard deviation of the scan from the residuals of the quadrics.

    Where it is large beside the spacing, a small neighbourhood is as thick as it is wide and its quadric bends into
    the noise: the neighbourhood is widened until its radius is three times the noise. Each widening adds less than the
    one before, unless it brings in the other side of a thin wall.
    """
    noise, k, added = _quiet(residual, QUADRIC_NEIGHBORS), QUADRIC_NEIGHBORS, FIRST_WIDENING
    rows = np.linspace(0, len(points) - 1, min(NOISE_SAMPLE, len(points))).astype(int)
    while spacing * np.sqrt(k / np.pi) < 3.0 * noise and 2 * k <= min(len(points), 500):
        k = 2 * k
        wider = _quiet(_quadrics(points, host.knn(points[rows], points, k=k))[1], k)
        if wider / noise > added:
            break
        noise, added = max(noise, wider), wider / noise
    return noise


def _quiet(residual: Float[np.ndarray, " n"], k: int) -> float:
    """The noise that explains the quiet quantile of the residuals of quadrics over k neighbours.

    A clean cloud of thin walls has few smooth neighbourhoods: where the quietest tenth is ten times quieter than the
    noise read from the quiet third, that third mixes two walls and the tenth is believed.
    """
    freedom = max(k - 6, 1)
    third, tenth = (  # chi squared has the quantile 2 gammaincinv(freedom / 2, share)
        float(np.quantile(residual, share)) / float(np.sqrt(2.0 * gammaincinv(freedom / 2.0, share) / freedom))
        for share in (QUIET, QUIETEST)
    )
    return tenth if tenth < 0.1 * third else third


def _quadrics(points: Float[np.ndarray, "n 3"], neighbors: Neighbors) -> tuple[np.ndarray, np.ndarray]:
    """Unit normal of the least-squares quadric around each of m places, and the rms of what it leaves over."""
    index = np.asarray(neighbors.index)
    upwards = host.pca_normals(points, k=index.shape[1], neighbors=neighbors).normal
    coordinates, starts = np.ascontiguousarray(points.T), range(0, len(index), CHUNK)
    chunks = [(index[start : start + CHUNK], upwards[start : start + CHUNK]) for start in starts]
    with ThreadPoolExecutor(num_cores()) as pool:  # NumPy computes without holding the interpreter
        normal, residual = zip(*pool.map(lambda chunk: _quadric_chunk(coordinates, *chunk), chunks), strict=True)
    return np.concatenate(normal), np.concatenate(residual)


def _quadric_chunk(coordinates: np.ndarray, index: np.ndarray, upwards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heights along the given normals, from the first point of each row."""
    offset = np.stack([axis.take(index) for axis in coordinates])
    offset -= offset[:, :, :1]
    size = np.sqrt(np.maximum(np.einsum("cmk,cmk->mk", offset, offset).max(axis=1), 1e-300))
    offset /= size[:, None]
    frame = _frames(upwards)
    x, y, z = (np.einsum("cmk,mc->mk", offset, axis) for axis in frame)
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    gram = design @ np.swapaxes(design, 1, 2) + 1e-9 * np.eye(6)[None]
    coefficients = np.linalg.solve(gram, design @ z[:, :, None])[:, :, 0]
    left = z - np.einsum("mj,mjk->mk", coefficients, design)
    freedom = max(index.shape[1] - 6, 1)
    residual = np.sqrt(np.einsum("mk,mk->m", left, left) / freedom) * size
    normal = frame[2] - coefficients[:, 1:2] * frame[0] - coefficients[:, 2:3] * frame[1]
    return normal / np.linalg.norm(normal, axis=1, keepdims=True), residual


def _frames(upwards: Float[np.ndarray, "m 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three perpendicular unit vectors at each place, the last of them the given one."""
    across = np.cross(upwards, np.eye(3)[np.abs(upwards).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return across, np.cross(upwards, across), upwards
