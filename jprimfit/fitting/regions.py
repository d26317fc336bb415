"""One region grown by one kind: refit, take what agrees and is connected, until nothing changes.

A point agrees if it lies within the tolerance of the surface and, where its neighbourhood is smooth ("core"), if its
normal does; it is connected through core points only. Host code; lengths in the normalised frame. n points,
k neighbours.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from jprimfit.fitting import kinds
from jprimfit.fitting.local import LocalSurface
from jprimfit.primitives.table import KINDS, MODULES
from jprimfit.types import Primitive

MIN_COSINE = np.cos(np.radians(25.0))  # between a core point's normal and the primitive's
MIN_EXCESS = 5  # points beyond the degrees of freedom that a region must have
MAX_SEED_RMS = 2.0  # tolerances; a first fit worse than this is not grown
GROWTH_ROUNDS = 16
SETTLED = 0.005  # of a region's points: a round that changes no more is the last
HANDICAP = {"plane": 1.0, "sphere": 0.96, "cylinder": 0.97, "cone": 0.88}  # factor on the evidence
FULL_EVIDENCE = 4.5  # nats of a point at distance 0: half of three standard deviations squared
TYPE_WEIGHT = 0.5  # of a point's log-probability of the kind: neighbours say the same, so it is not evidence of its own
NARROW = 2.1  # tolerances: radius of a disk that a region must have the points of


class Region(NamedTuple):
    """Connected points of one primitive."""

    rows: Int[np.ndarray, " r"]  # rows of the cloud, ascending; rows beside an edge may be in several regions
    primitive: Primitive  # float64, frame of the cloud
    evidence: float = 0.0  # nats: gain in log-likelihood over leaving the rows unexplained, handicap and types included


class Ground(NamedTuple):
    """A cloud while regions are grown on it; the last two change as regions are found."""

    points: Float[np.ndarray, "n 3"]
    surface: LocalSurface
    cloud: kinds.Cloud
    links: Int[np.ndarray, "n k"]  # nearest neighbours of each point
    log_types: Float[np.ndarray, "n 4"]  # of each kind at each point, 0 where nobody knows
    tolerance: float
    sought: tuple[str, ...]  # kinds
    taken: Bool[np.ndarray, " n"]  # core of a region: for no other
    claimed: Bool[np.ndarray, " n"]  # explained by a region, yet open to others


def grow(ground: Ground, patch: Int[np.ndarray, " p"], kind: str) -> Region | None:
    """What one kind makes of a patch of rows; None where it does not fit the patch, or explains too little."""
    points, surface = ground.points, ground.surface
    # A region hardly wider than the band it is found in could be a speck of noise.
    least = max(MIN_EXCESS + MODULES[kind].NUM_FREEDOM, int(surface.num_in_disk(NARROW * ground.tolerance)))
    rows, primitive, evidence = patch, None, 0.0
    free = of_free = None
    for _ in range(GROWTH_ROUNDS):
        worst = MAX_SEED_RMS * ground.tolerance if primitive is None else np.inf
        fitted = refitted(ground, kind, rows, start=primitive, worst=worst)
        if fitted is None or fitted.rms > worst:
            break
        if free is None or of_free is None:  # most seeds end before they need them
            free = np.flatnonzero(~ground.taken)
            of_free = ground.cloud.coordinates[:, free]
        center = points[rows].mean(axis=0)
        reach = 2.0 * np.sqrt(np.square(points[rows] - center).sum(axis=1).max()) + 2.0 * surface.spacing
        near = free[np.square(of_free - center[:, None]).sum(axis=0) <= reach * reach]
        distance, cosine = ground.cloud.agreement(fitted.primitive, near)
        agrees = (distance <= ground.tolerance) & ((cosine >= MIN_COSINE) | ~surface.core[near])
        grown, members = _connected(ground, near[agrees], rows)
        if len(grown) < max(least, 0.5 * len(patch)) or len(grown) < 0.9 * len(rows):
            break
        done = len(np.setxor1d(grown, rows, assume_unique=True)) <= SETTLED * len(grown)
        rows, primitive = grown, fitted.primitive
        evidence = evidence_of(ground, kind, grown, distance[agrees][members])
        if done:
            break
    return None if primitive is None else Region(rows, primitive, evidence)


def _connected(ground: Ground, members: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The component of the members, linked through core points, that holds most of rows, and its places among them."""
    number = np.full(len(ground.points), -1)
    number[members] = np.arange(len(members))
    core, links = ground.surface.core, ground.links[members]
    ends = number[links]
    inside = (ends >= 0) & (core[members][:, None] | core[links])
    bounds = np.concatenate([[0], np.cumsum(inside.sum(axis=1))])
    graph = csr_matrix((np.ones(bounds[-1]), ends[inside], bounds), shape=(len(members),) * 2)
    component = connected_components(graph, directed=False)[1]
    seeds = number[rows]
    seeds = seeds[seeds >= 0]
    if len(seeds) == 0:
        return seeds, seeds
    places = np.flatnonzero(component == np.bincount(component[seeds]).argmax())
    return members[places], places


def refitted(ground: Ground, kind: str, rows: Int[np.ndarray, " r"], **how: Any) -> kinds.Fitted | None:
    """A guess at the primitive of one kind through the rows, from some of them; how: as in kinds.fit."""
    normals = ground.surface.normal
    return kinds.fit(kind, ground.points, normals, rows, sample=kinds.FEW, determined=False, **how)


def evidence_of(ground: Ground, kind: str, rows: Int[np.ndarray, " r"], distance: Float[np.ndarray, " r"]) -> float:
    """What rows at these distances, and a network's types of them, say for a primitive.

    A distance at the limit, three standard deviations, says nothing.
    """
    fit = FULL_EVIDENCE * float(np.sum(1.0 - np.square(distance / ground.tolerance)))
    return HANDICAP[kind] * fit + TYPE_WEIGHT * float(ground.log_types[rows, KINDS.index(kind)].sum())


def window(ground: Ground, rows: Int[np.ndarray, " r"]) -> Ground:
    """Some rows as a cloud of their own; a link that leads out of them leads back to where it starts."""
    own = np.arange(len(rows))
    number = np.full(len(ground.points), -1)
    number[rows] = own
    links = number[ground.links[rows]]
    links = np.where(links < 0, own[:, None], links)
    surface = ground.surface._replace(normal=ground.surface.normal[rows], core=ground.surface.core[rows])
    points, nothing = ground.points[rows], np.zeros(len(rows), dtype=bool)
    cloud, types = kinds.Cloud(points, surface.normal), ground.log_types[rows]
    return Ground(points, surface, cloud, links, types, ground.tolerance, ground.sought, nothing, nothing)
