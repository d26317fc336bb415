"""Which regions lie on one geometric surface, and the surface fitted to all of them together.

A large region knows its surface better than a small one, so the larger one's primitive is held against the smaller
one's points: if it explains them, normals included, they are one surface whatever kind the small region was taken
for. Regions of one kind that are alike but too noisy for that test are fitted jointly: one surface if the joint fit
is no worse than the separate ones. Lengths in the normalised frame. r regions.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jprimfit.fitting import kinds
from jprimfit.fitting.regions import Region
from jprimfit.types import Primitive

SAMPLE = 256  # points of a region that another region's primitive is held against
EXPLAINED = 0.85  # share of them that it must explain
MIN_COSINE = np.cos(np.radians(20.0))
ECHO_COSINE = np.cos(np.radians(15.0))
JOINT_GROWTH = 1.15  # how much worse a joint fit may be than the separate ones
JOINT_NOISE = 0.45  # or how large its rms, in tolerances: 1.35 noises


class Surface(NamedTuple):
    """One geometric surface: the united points of its regions and the primitive through all of them."""

    rows: Int[np.ndarray, " r"]
    primitive: Primitive


def merge_regions(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], regions: list[Region], *, tolerance: float
) -> list[Surface]:
    """Unites the regions that lie on one surface; surfaces by falling number of points."""
    surfaces: list[Surface] = []
    for region in sorted(regions, key=lambda region: -len(region.rows)):
        home = _home(points, normals, surfaces, region, tolerance)
        if home is None:
            surfaces.append(Surface(region.rows, region.primitive))
            continue
        index, primitive = home
        surfaces[index] = Surface(np.union1d(surfaces[index].rows, region.rows), primitive)
    return sorted(surfaces, key=lambda surface: -len(surface.rows))


def echoes(points: Float[np.ndarray, "n 3"], surfaces: list[Surface], *, tolerance: float) -> float:
    """Share of the points on surfaces that run along another one, at least twice as large, within two tolerances.

    surfaces: by falling number of points, as merge_regions gives them.
    """
    num_echoed = 0
    for number, surface in enumerate(surfaces):
        sample = _sample(points, surface.primitive, surface.rows)
        larger = [other.primitive for other in surfaces[:number] if len(other.rows) >= 2 * len(surface.rows)]
        if larger:
            distance, cosine = sample.agreements(larger)
            along = (np.median(cosine, axis=1) > ECHO_COSINE) & (np.median(distance, axis=1) < 2.0 * tolerance)
            num_echoed += len(surface.rows) * bool(along.any())
    return num_echoed / len(points)


def _home(points, normals, surfaces, region, tolerance) -> tuple[int, Primitive] | None:
    """The surface that the region lies on and its primitive with the region added; None where there is none."""
    sample = _sample(points, region.primitive, region.rows)
    errors = _misfits(sample, [surface.primitive for surface in surfaces], tolerance)
    for index in np.argsort(errors, kind="stable"):
        surface = surfaces[index]
        if errors[index] <= 1.0:
            joint = _joint(points, normals, surface, region)
            return int(index), joint if joint is not None else surface.primitive
        if surface.primitive.kind != region.primitive.kind or errors[index] > 4.0:
            continue
        joint = _joint(points, normals, surface, region)
        if joint is None:
            continue
        other = _sample(points, surface.primitive, surface.rows)
        if all(_is_as_good(*pair, joint, tolerance) for pair in ((sample, region), (other, surface))):
            return int(index), joint
    return None


def _joint(points, normals, surface, region) -> Primitive | None:
    rows = np.union1d(surface.rows, region.rows)
    fitted = kinds.fit(surface.primitive.kind, points, normals, rows, sample=SAMPLE, start=surface.primitive)
    return None if fitted is None else fitted.primitive


def _sample(points, primitive, rows) -> kinds.Cloud:
    """Some of the rows with the normals of the primitive itself: those of the cloud mean little beside an edge."""
    if len(rows) > SAMPLE:
        rows = rows[np.linspace(0, len(rows) - 1, SAMPLE).astype(int)]
    return kinds.Cloud(points[rows], kinds.normals(primitive, points[rows]))


def _misfits(sample: kinds.Cloud, primitives: list[Primitive], tolerance: float) -> Float[np.ndarray, " p"]:
    """For each primitive at most 1 if it explains the sample: the EXPLAINED quantile of distance / tolerance.

    Infinite where the normals differ.
    """
    if not primitives:
        return np.zeros(0)
    distance, cosine = sample.agreements(primitives)
    misfits = np.quantile(distance, EXPLAINED, axis=1) / tolerance
    return np.where(np.median(cosine, axis=1) < MIN_COSINE, np.inf, misfits)


def _is_as_good(sample: kinds.Cloud, own: Region | Surface, joint: Primitive, tolerance: float) -> bool:
    before = np.sqrt(np.square(sample.agreement(own.primitive)[0]).mean())
    after = np.sqrt(np.square(sample.agreement(joint)[0]).mean())
    return bool(after <= max(JOINT_GROWTH * before, JOINT_NOISE * tolerance))
