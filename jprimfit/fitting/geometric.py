"""From points to primitives by geometry alone: the answer that a network has to beat.

describe the neighbourhoods -> grow regions -> unite those on one surface -> give every point to its surface, refit,
and again -> split the surfaces into connected faces. A large cloud is grown on a sample and assigned in full.
Host code around jitted fits; lengths in the normalised frame.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jprimfit.fitting import assignment, growing, kinds, local, merging
from jprimfit.geometry import host
from jprimfit.types import Primitive

MAX_GROWN = 32_768  # points that regions are grown on
ROUNDS = 2  # of assignment and refit


class Segmentation(NamedTuple):
    """The faces of a cloud, their primitives, and the noise they were fitted under."""

    labels: Int[np.ndarray, " n"]  # int32, face of each point, -1 = none
    primitives: tuple[Primitive, ...]  # one per face; faces of one surface hold the same one
    surface_of: Int[np.ndarray, " faces"]  # int32, surface of each face
    normals: Float[np.ndarray, "n 3"]  # unit, of either sign
    noise: float  # standard deviation along the normal, length


def segment(
    points: Float[np.ndarray, "n 3"], *, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> Segmentation:
    """Faces and primitives of n >= 4 points in the normalised frame. seed: of the sample that a large cloud is grown on."""
    full = local.describe(points)
    rows = np.arange(len(points))
    if len(points) > MAX_GROWN:
        rows = np.sort(np.random.default_rng(seed).choice(len(points), MAX_GROWN, replace=False))
    sample = full if len(rows) == len(points) else local.describe(points[rows])
    regions = growing.grow_regions(points[rows], sample, progress=progress)
    tolerance = growing.tolerance(sample)
    surfaces = merging.merge_regions(points[rows], sample.normal, regions, tolerance=tolerance)
    labels = np.full(len(rows), -1, dtype=np.int32)
    for number, surface in enumerate(surfaces):
        labels[surface.rows] = number
    if len(rows) < len(points):
        labels = labels[np.asarray(host.knn(points, points[rows], k=1).index)[:, 0]]
    for _ in range(ROUNDS):
        labels = assignment.assign(points, full, surfaces, labels, tolerance=tolerance)
        surfaces = [_refit(points, full, labels, number, surface) for number, surface in enumerate(surfaces)]
    face, surface_of = assignment.faces(full, labels)
    primitives = tuple(surfaces[number].primitive for number in surface_of)
    # Surfaces that lost all their faces leave no number behind.
    surface_of = np.unique(surface_of, return_inverse=True)[1].astype(np.int32)
    return Segmentation(face, primitives, surface_of, full.normal, full.noise)


def _refit(points, surface: local.LocalSurface, labels, number: int, before: merging.Surface) -> merging.Surface:
    """The surface through the points it has now; points off smooth ground, on edges, are left out of the fit."""
    rows = np.flatnonzero((labels == number) & surface.core)
    if len(rows) < 12:
        rows = np.flatnonzero(labels == number)
    if len(rows) < 6:
        return before
    fitted = kinds.fit(before.primitive.kind, points, surface.normal, rows, start=before.primitive)
    return merging.Surface(rows, fitted.primitive if fitted else before.primitive)
