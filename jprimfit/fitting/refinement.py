"""From surfaces proposed on a sample to the answer at full resolution: every point assigned, every surface refitted.

Assign each point to its surface, give specks and needless surfaces to what lies around them, refit each surface to its
points, and again; then split the surfaces into connected faces. Assignment and parameters come from the raw points,
whatever was thinned or smoothed for the proposal. Host code; lengths in the normalised frame. n points, f faces.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int32

from jprimfit.fitting import assignment, final, growing, kinds, local
from jprimfit.fitting.merging import Surface
from jprimfit.types import Cylinder, Primitive

ROUNDS = 2  # of assignment and refit
MIN_CORE = 12  # smooth points from which a surface is refitted without those beside edges


class Segmentation(NamedTuple):
    """The faces of a cloud, their primitives, and the noise they were fitted under."""

    labels: Int32[np.ndarray, " n"]  # face of each point, -1 = none
    primitives: tuple[Primitive, ...]  # one per face; faces of one surface hold the same one, but for its gauge
    surface_of: Int32[np.ndarray, " f"]  # surface of each face
    normals: Float64[np.ndarray, "n 3"]  # unit, of either sign: of the primitive; of the points where there is none
    distances: Float64[np.ndarray, " n"]  # >= 0, to the primitive of the label; NaN where it is -1
    noise: float  # standard deviation along the normal, length


def refine(
    points: Float64[np.ndarray, "n 3"],
    surfaces: list[Surface],
    labels: Int32[np.ndarray, " n"],
    normals: Float64[np.ndarray, "n 3"] | None = None,
    *,
    noise: float | None = None,
    described: local.LocalSurface | None = None,
    min_points: int = assignment.MIN_FACE,
) -> Segmentation:
    """Faces and primitives of a cloud from surfaces and a first guess of each point's surface (-1 = none).

    normals: unit, where they were measured. noise: that the surfaces were found under; else it is estimated.
    described: the points, where that is known; normals and noise then mean nothing. min_points: of a face.
    """
    described = described or local.describe(points, normals=normals, noise=noise, narrow=True)
    tolerance, links = growing.tolerance(described), assignment.linked(points, described)
    # A proposal from a smoothed cloud is shrunk: to the raw points first, before any of them is held against it.
    surfaces = [_refit(points, described, labels, number, surface) for number, surface in enumerate(surfaces)]
    for _ in range(ROUNDS):
        labels = assignment.assign(points, described, surfaces, labels, tolerance=tolerance)
        labels = assignment.without_specks(links, described, labels, tolerance=tolerance, min_points=min_points)
        labels = assignment.without_needless(points, described, surfaces, links, labels, tolerance=tolerance)
        labels = assignment.assign(points, described, surfaces, labels, tolerance=tolerance)
        surfaces = [_refit(points, described, labels, number, surface) for number, surface in enumerate(surfaces)]
    faces, surface_of = assignment.faces(links, labels, min_points=min_points)
    settled = {
        number: final.settled(surfaces[number].primitive, points[surfaces[number].rows])
        for number in np.unique(surface_of).tolist()
    }
    return segmentation(points, described, faces, [settled[number] for number in surface_of.tolist()], surface_of)


def segmentation(
    points: Float64[np.ndarray, "n 3"],
    described: local.LocalSurface,
    labels: Int32[np.ndarray, " n"],
    of_faces: list[Primitive],
    surface_of: Int32[np.ndarray, " f"],
) -> Segmentation:
    """The answer in which every face, of which each has a point, keeps the points of its label."""
    primitives = []
    distances, of_points = np.full(len(points), np.nan), described.normal.copy()
    for number, primitive in enumerate(of_faces):
        rows = np.flatnonzero(labels == number)
        primitives.append(_centred(primitive, points[rows].mean(axis=0)))
        distances[rows] = kinds.distances(primitives[-1], points[rows])
        of_points[rows] = kinds.normals(primitives[-1], points[rows])
    # Surfaces that lost all their faces leave no gap in the numbers.
    surface_of = np.unique(surface_of, return_inverse=True)[1].astype(np.int32)
    return Segmentation(labels, tuple(primitives), surface_of, of_points, distances, described.noise)


def _centred(primitive: Primitive, mean: Float64[np.ndarray, "3"]) -> Primitive:
    """The primitive with the center of a cylinder moved along the axis to the point nearest the mean of its face."""
    if not isinstance(primitive, Cylinder):
        return primitive
    axis, center = np.asarray(primitive.axis), np.asarray(primitive.center)
    return primitive._replace(center=center + axis * np.dot(mean - center, axis))


def _refit(points, described: local.LocalSurface, labels, number: int, before: Surface) -> Surface:
    """The surface through the points it has now; those beside edges, where labels are doubtful, do not vote."""
    rows = np.flatnonzero((labels == number) & described.core)
    if len(rows) < MIN_CORE:
        rows = np.flatnonzero(labels == number)
    if len(rows) < MIN_CORE // 2:
        return before
    fitted = kinds.fit(before.primitive.kind, points, described.normal, rows, start=before.primitive)
    return Surface(rows, fitted.primitive if fitted else before.primitive)
