"""Surfaces through segments that somebody else drew: a person who merged, split or retyped, or another program.

Points keep their segments; what is sought is the kind of each, unless that is given too, and its parameters. Of the
kinds that a segment determines the one with the shortest description is taken,

    sum_n min(d_n^2 / noise^2, 9) + f log n,

with d the distances and f the degrees of freedom of the kind: Schwarz's criterion (1978) with a robust sum. Host code;
lengths in the normalised frame. n points, s segments.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64, Int, Int32

from jprimfit.fitting import final, growing, kinds, local, merging
from jprimfit.fitting.refinement import Segmentation, segmentation
from jprimfit.fitting.regions import Region
from jprimfit.primitives.table import KINDS, MODULES
from jprimfit.types import Primitive

ROUNDS = 2  # of a fit without the points that the one before leaves too far off
FAR = 9.0  # squared standard deviations from which distances count alike


def fit_segments(
    points: Float64[np.ndarray, "n 3"],
    labels: Int[np.ndarray, " n"],
    normals: Float64[np.ndarray, "n 3"] | None = None,
    *,
    sought: Sequence[str] = KINDS,
    kind_of: Mapping[int, str] | None = None,
    noise: float | None = None,
) -> Segmentation:
    """The primitive of each segment, numbered in the order of the labels; segments of one surface share its number.

    Args:
        points: n >= 4 of them.
        labels: segment of each point, below 0 = none. A segment that determines no primitive becomes -1.
        normals: unit, of either sign, where they were measured.
        sought: kinds among which those of the segments are chosen.
        kind_of: kind of some labels, which is then not chosen.
        noise: standard deviation along the normal, where it is known.
    """
    described = local.describe(points, normals=normals, noise=noise)
    scale = growing.tolerance(described) / 3.0
    kept = np.full(len(points), -1, np.int32)
    regions: list[Region] = []
    for label in np.unique(labels[labels >= 0]):
        rows = np.flatnonzero(labels == label)
        of_label = sought if kind_of is None or label not in kind_of else (kind_of[int(label)],)
        primitive = _likeliest(points, described.normal, rows, of_label, scale)
        if primitive is not None:
            kept[rows] = len(regions)
            regions.append(Region(rows, primitive))
    primitives, surface_of = _united(points, described, regions)
    return segmentation(points, described, kept, primitives, surface_of)


def _likeliest(points, normals, rows: np.ndarray, of_kinds: Sequence[str], scale: float) -> Primitive | None:
    """The primitive of shortest description; of one kind only, where it is given, any that can be fitted."""
    best, shortest = None, np.inf
    for kind in of_kinds:
        freedom = MODULES[kind].NUM_FREEDOM
        fitted = kinds.fit(kind, points, normals, rows, determined=len(of_kinds) > 1)
        for _ in range(ROUNDS):
            if fitted is None:
                break
            near = rows[kinds.distances(fitted.primitive, points[rows]) <= 3.0 * max(scale, fitted.rms)]
            if len(near) in (0, len(rows)):
                break
            fitted = kinds.fit(kind, points, normals, near, start=fitted.primitive) or fitted
        if fitted is None or len(rows) < freedom:
            continue
        distance = kinds.distances(fitted.primitive, points[rows])
        length = float(np.minimum(np.square(distance / scale), FAR).sum()) + freedom * np.log(len(rows))
        if length < shortest:
            best, shortest = fitted.primitive, length
    return best


def _united(
    points: Float64[np.ndarray, "n 3"], described: local.LocalSurface, regions: list[Region]
) -> tuple[list[Primitive], Int32[np.ndarray, " s"]]:
    """The primitive and the number of the surface of each region; only regions of one kind can lie on one."""
    primitives, surface_of, count = [region.primitive for region in regions], np.zeros(len(regions), np.int32), 0
    tolerance = growing.tolerance(described)
    for kind in KINDS:
        mine = [number for number, region in enumerate(regions) if region.primitive.kind == kind]
        surfaces = merging.merge_regions(
            points, described.normal, [regions[number] for number in mine], tolerance=tolerance
        )
        for surface in surfaces:
            inside = [number for number in mine if np.isin(regions[number].rows[0], surface.rows)]
            joint = None
            if len(inside) > 1:
                joint = kinds.fit(kind, points, described.normal, surface.rows, start=surface.primitive)
            primitive = joint.primitive if joint else surface.primitive
            primitive = final.settled(primitive, points[surface.rows], noise=tolerance / 3.0)
            for number in inside:
                primitives[number] = primitive
                surface_of[number] = count
            count += 1
    return primitives, surface_of
