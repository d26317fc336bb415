"""Surfaces grown from a network's patches, if there are any, then from seeds; all four kinds in competition.

From a seed patch deep inside a smooth area each kind of primitive is fitted and grown: refit, take every point that
lies within the tolerance of the surface, agrees with its normal and is connected to the patch through smooth ("core")
points, until the region no longer changes. The first kind that grows is the start; another that fits its region
significantly better is grown from there and wins by the evidence of what it explains, with a handicap for its freedom,
since a cone can always pose as a cylinder and a cylinder as a plane. The next seed is the deepest point left
(region growing: Besl and Jain 1988; core and border points: Ester et al. 1996). Points beside an edge are not
core; a region only claims those it explains, and another region may claim them too. Host code around the jitted fits
of fitting/kinds. Lengths in the normalised frame. n points, k neighbours.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jprimfit.fitting import kinds
from jprimfit.fitting.advice import Advice
from jprimfit.fitting.local import LocalSurface, describe
from jprimfit.primitives.table import KINDS, MODULES
from jprimfit.types import Cone, Primitive

NUM_LINKS = 8  # nearest neighbours that connect a point
MAX_NORMAL_ANGLE = np.radians(25.0)  # between a core point's normal and the primitive's
SEED_POINTS = (8, 64)  # least and most points of a seed patch on a clean cloud
GIVEN_UP = 0.5  # of the radius of a seed patch that no kind explains
MIN_EXCESS = 5  # points beyond the degrees of freedom that a region must have
MAX_SEED_RMS = 2.0  # tolerances; a first fit worse than this is not grown
GROWTH_ROUNDS = 16
CLAIM_RINGS = 3  # links that a claim reaches beyond the core of a region
HANDICAP = {"plane": 1.0, "sphere": 0.96, "cylinder": 0.97, "cone": 0.88}  # factor on the evidence
TYPE_WEIGHT = 0.5  # of a point's log-probability of the kind: neighbours say the same, so it is not evidence of its own
NARROW = 2.1  # tolerances: radius of a disk that a region must have the points of
MAX_PASSES = 4
SMALL_REGION = 80  # points; a larger region of a clean cloud is no coincidence
SIGNIFICANT = 8.0  # nats that another kind must fit the same points better to be tried
QUIET = 0.05  # noise per spacing
MAX_UPRIGHT = np.radians(1.0)  # half-angle of a cone that may be a cylinder
FACET_SEEDS, FACET_POINTS = 7, 16  # places in a curved region where a plane is tried, and points to begin it with


class Region(NamedTuple):
    """Connected points of one primitive."""

    rows: Int[np.ndarray, " r"]  # rows of the cloud, ascending; rows beside an edge may be in several regions
    primitive: Primitive  # float64, frame of the cloud
    evidence: float = 0.0  # nats: gain in log-likelihood over leaving the rows unexplained, handicap and types included


class _Pass(NamedTuple):
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


def tolerance(surface: LocalSurface) -> float:
    """Largest distance of a point to its primitive: three times the noise, on a clean cloud a part of the spacing."""
    return max(3.0 * surface.noise, 0.005 * surface.spacing)


def is_quiet(surface: LocalSurface) -> bool:
    """Whether a patch of a few dozen points shows its kind in spite of the noise."""
    return surface.noise < QUIET * surface.spacing


def grow_regions(
    points: Float[np.ndarray, "n 3"],
    surface: LocalSurface,
    *,
    normals: Float[np.ndarray, "n 3"] | None = None,
    advice: Advice | None = None,
    sought: tuple[str, ...] = KINDS,
    progress: Callable[[int, int], None] | None = None,
) -> list[Region]:
    """All regions of a cloud, in the order they were found.

    What a pass leaves is looked at anew without the points that are explained: a wall three points high has no smooth
    neighbourhood as long as the faces above and below are seen too. Its edges, which those faces claim, stay in view.
    normals: measured ones, where the surface was described with them. advice: of a network; its patches are grown
    first, the largest before the others, and the kinds that it expects have an advantage. sought: the kinds that are
    looked for. progress: called with (points explained or given up, points in all).
    """
    regions: list[Region] = []
    whole = surface
    rows = np.arange(len(points))
    claimed = np.zeros(len(points), dtype=bool)
    open_rows = np.ones(len(points), dtype=bool)
    log_types = np.zeros((len(points), len(KINDS))) if advice is None else advice.log_types
    for number in range(MAX_PASSES):
        state = _start(points[rows], surface, claimed, log_types[rows], sought)
        found = _grow_patches(state, advice.patches) if advice is not None and number == 0 else []
        found += _grow_pass(state, open_rows)
        regions += [region._replace(rows=rows[region.rows]) for region in found]
        left = ~state.taken & ~state.claimed
        if progress is not None:
            progress(len(points) - int(left.sum()), len(points))
        if not found or left.sum() < 3:
            break
        beside = state.claimed & (KDTree(state.points[left]).query(state.points)[0] <= 1.25 * surface.spacing)
        keep = left | beside
        # Where nothing was taken away from around a seed it would fail again.
        open_rows = KDTree(state.points[~keep]).query(state.points[keep])[0] <= _widest_seed(surface)
        rows, claimed = rows[keep], beside[keep]
        if len(rows) < MIN_EXCESS + 3:
            break
        measured = None if normals is None else normals[rows]
        surface = describe(points[rows], normals=measured, noise=surface.noise, spacing=surface.spacing)
    return _closed(regions, whole) if is_quiet(whole) else regions


def _closed(regions: list[Region], surface: LocalSurface) -> list[Region]:
    """The regions without small ones amid smooth surface that none of the four kinds explains, such as a torus.

    A face ends at edges or at other faces. A small patch that happens to fit a torus or free form ends nowhere: most
    links out of it lead to smooth points of no region, or of another such patch.
    """
    owner = np.full(len(surface.core), -1)
    for number, region in enumerate(regions):
        owner[region.rows] = number
    small = np.array([len(region.rows) < SMALL_REGION for region in regions] + [True])
    kept = []
    for number, region in enumerate(regions):
        beyond = surface.index[region.rows, 1 : NUM_LINKS + 1].ravel()
        beyond = beyond[owner[beyond] != number]
        is_open = surface.core[beyond] & small[owner[beyond]]
        if not small[number] or not len(beyond) or is_open.mean() < 0.5:
            kept.append(region)
    return kept


def _start(points, surface: LocalSurface, claimed, log_types: np.ndarray, sought=KINDS) -> _Pass:
    links = surface.index[:, 1 : NUM_LINKS + 1]
    cloud = kinds.Cloud(points, surface.normal)
    taken = np.zeros(len(points), dtype=bool)
    return _Pass(points, surface, cloud, links, log_types, tolerance(surface), sought, taken, claimed.copy())


def _grow_patches(state: _Pass, patches: tuple[Int[np.ndarray, "_"], ...]) -> list[Region]:
    """Regions from the smooth points of given patches, the largest first; marks what they take and claim."""
    regions: list[Region] = []
    for patch in sorted(patches, key=lambda patch: -len(patch)):
        rows = patch[state.surface.core[patch] & ~state.taken[patch] & ~state.claimed[patch]]
        if len(rows) < max(SEED_POINTS[0], 0.5 * state.surface.core[patch].sum()):
            continue  # too small, or mostly explained by others
        grown = [region for kind in state.sought if (region := _grow_kind(state, rows, kind)) is not None]
        if not grown:
            continue
        region = _outgrown(state, max(grown, key=lambda region: region.evidence))
        if _is_faceted(state, region):
            state.log_types[region.rows] = 0.0
        else:
            regions.append(_take(state, region))
    return regions


def _is_faceted(state: _Pass, region: Region) -> bool:
    """Whether planes lie better within a curved region than it does: under noise a hexagon passes for a cylinder.

    A strip of a truly curved surface is as wide as the tolerance lets a plane be wrong, so the plane fits it worse.
    """
    if region.primitive.kind == "plane" or "plane" not in state.sought:
        return False
    points, rows = state.points, region.rows
    curved, _ = state.cloud.agreement(region.primitive)
    votes = []
    for seed in rows[np.linspace(0, len(rows) - 1, FACET_SEEDS + 2).astype(int)[1:-1]]:
        near = rows[np.argsort(np.square(points[rows] - points[seed]).sum(axis=1))[:FACET_POINTS]]
        plane = _grow_kind(state, near, "plane")
        if plane is not None:
            both = np.intersect1d(plane.rows, rows)
            flat, _ = state.cloud.agreement(plane.primitive)
            gain = 4.5 * float(np.sum(np.square(curved[both]) - np.square(flat[both]))) / state.tolerance**2
            votes.append(gain > SIGNIFICANT)
    return sum(votes) > FACET_SEEDS / 2


def _take(state: _Pass, region: Region) -> Region:
    """The region with the points beside it that it claims; marks both in the state."""
    state.taken[region.rows[state.surface.core[region.rows]]] = True
    claims = _claim(state, region)
    state.claimed[claims] = True
    return Region(np.union1d(region.rows, claims), region.primitive, region.evidence)


def _grow_pass(state: _Pass, open_rows: Bool[np.ndarray, " n"]) -> list[Region]:
    """Regions from every seed among the open rows, deepest first; marks what they take and claim in the state."""
    points, core = state.points, state.surface.core
    seeds = open_rows & core & ~state.claimed & ~state.taken
    depth = np.full(len(points), np.inf)
    ends = ~core | state.taken
    if ends.any():
        depth = KDTree(points[ends]).query(points)[0]
    regions: list[Region] = []
    while seeds.any():
        seed = int(np.argmax(np.where(seeds, depth, -1.0)))
        region = _grow_seed(state, seed, float(depth[seed]))
        seeds[seed] = False
        if region is None:
            # The seed and its closest surroundings are given up, not only the seed: they would fail alike.
            seeds[state.surface.index[seed, :NUM_LINKS]] = False
            within = GIVEN_UP * _seed_radius(state, float(depth[seed]))
            seeds[np.square(points - points[seed]).sum(axis=1) <= within * within] = False
            continue
        regions.append(_take(state, region))
        rows = regions[-1].rows
        seeds[rows] = False
        if seeds.any():
            depth[seeds] = np.minimum(depth[seeds], KDTree(points[rows]).query(points[seeds])[0])
    return regions


def _grow_seed(state: _Pass, seed: int, depth: float) -> Region | None:
    """The best of the four kinds grown from one seed, None where none explains enough."""
    patch = _seed_patch(state, seed, depth)
    if len(patch) < SEED_POINTS[0]:
        return None
    quiet = is_quiet(state.surface)
    best: Region | None = None
    # The likeliest kind first; where nobody knows, the simplest. Under noise the first that grows is taken: evidence
    # of what a small seed became favours the freest kind (competition there cost 2 to 6 points of right types).
    likely = state.log_types[patch].sum(axis=0)
    for kind in sorted(state.sought, key=lambda kind: -likely[KINDS.index(kind)]):
        region = _grow_kind(state, patch, kind)
        if region is None:
            continue
        if best is None or region.evidence > best.evidence:
            best = region
        # Without noise a surface of too few degrees of freedom does not outgrow its seed; with noise see below.
        if not quiet or len(region.rows) > 2.5 * len(patch):
            break
    if best is None:
        return None
    region = _outgrown(state, best)
    if not quiet and _is_faceted(state, region):
        return _grow_kind(state, patch, "plane")
    return region


def _outgrown(state: _Pass, region: Region) -> Region:
    """The region, or what another kind makes of it, as long as that explains more."""
    while (better := _regrow(state, region)) is not None:
        region = better
    return _upright(state, region)


def _upright(state: _Pass, region: Region) -> Region:
    """A cone that hardly opens as a cylinder, where that fits its points as well."""
    cone = region.primitive
    if not isinstance(cone, Cone) or cone.half_angle > MAX_UPRIGHT or "cylinder" not in state.sought:
        return region
    own, other = _refitted(state, "cone", region.rows), _refitted(state, "cylinder", region.rows)
    if own is None or other is None:
        return region
    loss = 0.5 * len(region.rows) * (other.rms**2 - own.rms**2) / (state.tolerance / 3.0) ** 2
    if loss > SIGNIFICANT:
        return region
    distance, _ = state.cloud.agreement(other.primitive)
    return Region(region.rows, other.primitive, _evidence(state, "cylinder", region.rows, distance))


def _regrow(state: _Pass, region: Region) -> Region | None:
    """A region of another kind grown from this one's points that explains more; None where there is none.

    Noise hides the curvature of a seed patch, but not that of the strip which the wrong kind has grown from it. Only
    kinds that fit the strip significantly better are tried.
    """
    best = None
    own = _refitted(state, region.primitive.kind, region.rows)
    for kind in state.sought:
        if kind == region.primitive.kind:
            continue
        other = _refitted(state, kind, region.rows)
        if other is None or own is None:
            continue
        gain = 0.5 * len(region.rows) * (own.rms**2 - other.rms**2) / (state.tolerance / 3.0) ** 2
        if gain < SIGNIFICANT:
            continue
        grown = _grow_kind(state, region.rows, kind)
        if grown is not None and grown.evidence > max(region.evidence, best.evidence if best else 0.0):
            best = grown
    return best


def _refitted(state: _Pass, kind: str, rows: np.ndarray) -> kinds.Fitted | None:
    sample = kinds.SIZE_CLASSES[0]
    return kinds.fit(kind, state.points, state.surface.normal, rows, sample=sample, determined=False)


def _evidence(state: _Pass, kind: str, rows: np.ndarray, distance: np.ndarray) -> float:
    """What points at these distances, and a network's types of them, say for a primitive.

    A distance at the limit, three standard deviations, says nothing.
    """
    fit = float(np.sum(4.5 * (1.0 - np.square(distance[rows] / state.tolerance))))
    return HANDICAP[kind] * fit + TYPE_WEIGHT * float(state.log_types[rows, KINDS.index(kind)].sum())


def _seed_patch(state: _Pass, seed: int, depth: float) -> np.ndarray:
    """Points around the seed that lie no farther than the nearest edge, within the limits of SEED_POINTS."""
    points, radius = state.points, _seed_radius(state, depth)
    near = np.flatnonzero(~state.taken & (np.square(points - points[seed]).sum(axis=1) <= radius * radius))
    if len(near) >= SEED_POINTS[0]:
        return near
    near = state.surface.index[seed]
    return np.unique(near[~state.taken[near]])


def _seed_radius(state: _Pass, depth: float) -> float:
    return float(np.clip(0.9 * depth, 2.0 * state.surface.spacing, _widest_seed(state.surface)))


def _widest_seed(surface: LocalSurface) -> float:
    """Radius of the largest seed patches, which noise widens."""
    widening = float(np.clip(2.0 * surface.noise / surface.spacing, 1.0, 5.0))
    return surface.spacing * widening * np.sqrt(SEED_POINTS[1] / np.pi)


def _grow_kind(state: _Pass, patch: np.ndarray, kind: str) -> Region | None:
    points, surface = state.points, state.surface
    # A region hardly wider than the band it is found in could be a speck of noise.
    least = max(MIN_EXCESS + MODULES[kind].NUM_FREEDOM, int(surface.num_in_disk(NARROW * state.tolerance)))
    rows, primitive, evidence = patch, None, 0.0
    for _ in range(GROWTH_ROUNDS):
        fitted = _refitted(state, kind, rows)
        if fitted is None or (primitive is None and fitted.rms > MAX_SEED_RMS * state.tolerance):
            break
        distance, cosine = state.cloud.agreement(fitted.primitive)
        center = points[rows].mean(axis=0)
        reach = 2.0 * np.sqrt(np.square(points[rows] - center).sum(axis=1).max()) + 2.0 * surface.spacing
        agrees = ~state.taken & (distance <= state.tolerance)
        agrees &= (cosine >= np.cos(MAX_NORMAL_ANGLE)) | ~surface.core
        agrees &= np.square(points - center).sum(axis=1) <= reach * reach
        grown = _connected(state, agrees, rows)
        if len(grown) < max(least, 0.5 * len(patch)) or len(grown) < 0.9 * len(rows):
            break
        done = np.array_equal(grown, rows)
        rows, primitive = grown, fitted.primitive
        evidence = _evidence(state, kind, grown, distance)
        if done:
            break
    return None if primitive is None else Region(rows, primitive, evidence)


def _connected(state: _Pass, agrees: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The component of agreeing points, linked through core points, that holds most of rows."""
    members = np.flatnonzero(agrees)
    number = np.full(len(agrees), -1)
    number[members] = np.arange(len(members))
    core = state.surface.core
    links = state.links[members]
    inside = agrees[links] & (core[members][:, None] | core[links])
    start, end = np.nonzero(inside)[0], number[links[inside]]
    matrix = coo_matrix((np.ones(len(start), dtype=np.int8), (start, end)), shape=(len(members), len(members)))
    _, component = connected_components(matrix, directed=False)
    seeds = number[rows]
    seeds = seeds[seeds >= 0]
    if len(seeds) == 0:
        return np.zeros(0, dtype=int)
    return members[component == np.bincount(component[seeds]).argmax()]


def _claim(state: _Pass, region: Region) -> np.ndarray:
    """Points beside the region that it explains and reaches within some links, whatever their normals say.

    On a clean cloud only those off the core: there a core point of another normal is on another surface.
    """
    distance, _ = state.cloud.agreement(region.primitive)
    fits = (distance <= state.tolerance) & ~state.taken
    rings = CLAIM_RINGS
    if is_quiet(state.surface):
        fits &= ~state.surface.core
    else:
        # As far as the neighbourhood of a normal reaches.
        rings += int(np.sqrt(state.surface.index.shape[1] / np.pi))
    reached = np.zeros(len(fits), dtype=bool)
    reached[region.rows] = True
    for _ in range(rings):
        open_rows = np.flatnonzero(fits & ~reached)
        beside = reached[state.links[open_rows]].any(axis=1)
        reached[open_rows[beside]] = True
    return np.flatnonzero(reached & fits)
