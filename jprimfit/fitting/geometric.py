"""Surfaces of a cloud by geometry alone: the answer that a network has to beat, and `fit --no-network`.

Describe the neighbourhoods, grow regions, unite those on one surface. Host code around jitted fits; lengths in the
normalised frame. What becomes of the surfaces at full resolution is the business of fitting/refinement.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int32

from jprimfit.fitting import growing, local, merging


class Proposal(NamedTuple):
    """Surfaces, and which of them each point of the cloud they were found in lies on."""

    surfaces: list[merging.Surface]  # by falling number of points
    labels: Int32[np.ndarray, " n"]  # index into surfaces, -1 = none


def propose(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"] | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Proposal:
    """The surfaces that explain n >= 4 points; a point in several of their regions goes to the smallest.

    normals: unit, sign free, where they were measured; else they are estimated. progress: called with (points
    explained, points in all).
    """
    described = local.describe(points, normals=normals)
    regions = growing.grow_regions(points, described, progress=progress)
    tolerance = growing.tolerance(described)
    surfaces = merging.merge_regions(points, described.normal, regions, tolerance=tolerance)
    labels = np.full(len(points), -1, dtype=np.int32)
    for number, surface in enumerate(surfaces):
        labels[surface.rows] = number
    return Proposal(surfaces, labels)
