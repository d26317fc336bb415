"""Surfaces of a cloud by geometry: with the advice of a network, or alone (`fit --no-network`), which it has to beat.

Describe the neighbourhoods, grow regions, unite those on one surface. The noise that neighbourhoods show is that of
single points; a stereo or depth camera also errs over wide areas, which breaks a table into terraces a few noises
apart. Such echoes of a large surface tell that the noise was underestimated: it is doubled and the cloud grown again,
as long as that explains the points.
Host code; lengths in the normalised frame. What becomes of the surfaces at full resolution is the
business of fitting/refinement.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int32

from jprimfit.fitting import growing, local, merging
from jprimfit.fitting.advice import Advice
from jprimfit.primitives.table import KINDS

MAX_ECHOES = 0.1  # share of the points in echoes that is put down to shape
# Standard deviation up to which a network's normals are taken: standard parts at 0.006 keep 86 % of their kinds and not
# 78; at 0.014 and 0.028 (Fit4CAD to 151, 0.5 and 1 % of the diagonal) wide neighbourhoods give 0.01 and 0.02 more DSC
# with the shipped network (-0.005 and +0.01 with the one before), and at 0.5 % 3 points of kinds less.
LEARNT_NOISE = 0.01
NUM_DOUBLINGS = 4  # of the noise, at most
WIDE = 0.5  # noise per spacing beyond which it was measured over areas wide enough


class Proposal(NamedTuple):
    """Surfaces, and which of them each point of the cloud they were found in lies on."""

    surfaces: list[merging.Surface]  # by falling number of points
    labels: Int32[np.ndarray, " n"]  # index into surfaces, -1 = none
    described: local.LocalSurface  # the cloud, with the noise that the surfaces hold under


def propose(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"] | None = None,
    *,
    advice: Advice | None = None,
    sought: tuple[str, ...] = KINDS,
    noise: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Proposal:
    """The surfaces that explain n >= 4 points; a point in several of their regions goes to the smallest.

    normals: unit, sign free, where they were measured; else they are estimated. advice: of a network; its normals
    serve where noise hides those of the points, but is no more than networks are trained for. sought: the kinds that
    are looked for. noise: of the scan, where it is known; it is not doubled then. progress: called with (points
    explained, points in all).
    """
    described = local.describe(points, normals=normals, noise=noise)
    noisy = not growing.is_quiet(described) and described.noise <= LEARNT_NOISE
    if advice is not None and normals is None and noisy:
        normals = advice.normals
        described = described._replace(normal=normals)

    def proposed(described: local.LocalSurface) -> Proposal:
        regions = growing.grow_regions(
            points, described, normals=normals, advice=advice, sought=sought, progress=progress
        )
        tolerance = growing.tolerance(described)
        surfaces = merging.merge_regions(points, described.normal, regions, tolerance=tolerance)
        labels = np.full(len(points), -1, dtype=np.int32)
        for number, surface in enumerate(surfaces):
            labels[surface.rows] = number
        return Proposal(surfaces, labels, local.under_noise(described, described.noise))

    found = proposed(described)
    for _ in range(NUM_DOUBLINGS):
        if growing.is_quiet(described) or described.noise > WIDE * described.spacing or noise is not None:
            break
        if merging.echoes(points, found.surfaces, tolerance=growing.tolerance(described)) <= MAX_ECHOES:
            break
        described = described._replace(noise=2.0 * described.noise)
        doubled = proposed(described)
        if (doubled.labels >= 0).mean() < (found.labels >= 0).mean() - MAX_ECHOES:
            break
        found = doubled
    return found
