"""Surfaces grown from a network's patches, if there are any, then from seeds; all four kinds in competition.

From a seed patch deep inside a smooth area each kind of primitive is grown (fitting/regions). The first kind that grows
is the start; another that fits its region significantly better is grown from there and wins by the evidence of what it
explains, with a handicap for its freedom, since a cone can always pose as a cylinder and a cylinder as a plane. The
next seed is the deepest point left (region growing: Besl and Jain 1988; core and border points: Ester et al. 1996).
Points beside an edge are not core; a region only claims those it explains, and another region may claim them too. Host
code. Lengths in the normalised frame. n points, k neighbours.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jprimfit.fitting import kinds
from jprimfit.fitting.advice import Advice
from jprimfit.fitting.local import LocalSurface, describe
from jprimfit.fitting.regions import (
    FULL_EVIDENCE,
    HANDICAP,
    MIN_EXCESS,
    Ground,
    Region,
    evidence_of,
    grow,
    refitted,
    window,
)
from jprimfit.geometry import host
from jprimfit.primitives.table import KINDS
from jprimfit.types import Cone

NUM_LINKS = 8  # nearest neighbours that connect a point
SEED_POINTS = (8, 64)  # least and most points of a seed patch on a clean cloud
GIVEN_UP = 0.5  # of the radius of a seed patch that no kind explains
CLAIM_RINGS = 3  # links that a claim reaches beyond the core of a region
MAX_PASSES = 4
SMALL_REGION = 80  # points; a larger region of a clean cloud is no coincidence
SIGNIFICANT = 8.0  # nats that another kind must fit the same points better to be tried
QUIET = 0.05  # noise per spacing
MAX_UPRIGHT = np.radians(1.0)  # half-angle of a cone that may be a cylinder
EXACT = 0.98  # of the points of a patch, and of the evidence for them
MIN_QUADRIC = 12  # points of a patch whose curvatures are believed
BENT, ROUND = 0.05, 0.8  # lesser curvature by the larger, beyond which a patch is no cylinder, or a sphere
SURELY_BENT = 8.0  # times what its quadric leaves over, and the tolerance, that a patch bends from middle to border
FACET_SEEDS, FACET_POINTS = 7, 16  # places in a curved region where a plane is tried, and points to begin it with


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
        ground = _start(points[rows], surface, claimed, log_types[rows], sought)
        found = _grow_patches(ground, advice.patches) if advice is not None and number == 0 else []
        found += _grow_pass(ground, open_rows)
        regions += [region._replace(rows=rows[region.rows]) for region in found]
        left = ~ground.taken & ~ground.claimed
        if progress is not None:
            progress(len(points) - int(left.sum()), len(points))
        if not found or left.sum() < 3:
            break
        beside = ground.claimed & (KDTree(ground.points[left]).query(ground.points)[0] <= 1.25 * surface.spacing)
        keep = left | beside
        # Where nothing was taken away from around a seed it would fail again.
        open_rows = KDTree(ground.points[~keep]).query(ground.points[keep])[0] <= _widest_seed(surface)
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


def _start(points, surface: LocalSurface, claimed, log_types: np.ndarray, sought=KINDS) -> Ground:
    links = surface.index[:, 1 : NUM_LINKS + 1]
    cloud = kinds.Cloud(points, surface.normal)
    taken = np.zeros(len(points), dtype=bool)
    return Ground(points, surface, cloud, links, log_types, tolerance(surface), sought, taken, claimed.copy())


def _grow_patches(ground: Ground, patches: tuple[Int[np.ndarray, "_"], ...]) -> list[Region]:
    """Regions from the smooth points of given patches, the largest first; marks what they take and claim."""
    regions: list[Region] = []
    for patch in sorted(patches, key=lambda patch: -len(patch)):
        rows = patch[ground.surface.core[patch] & ~ground.taken[patch] & ~ground.claimed[patch]]
        if len(rows) < max(SEED_POINTS[0], 0.5 * ground.surface.core[patch].sum()):
            continue  # too small, or mostly explained by others
        grown: list[Region] = []
        for kind in sorted(ground.sought, key=lambda kind: -HANDICAP[kind]):
            region = grow(ground, rows, kind)
            grown += [] if region is None else [region]
            if region is not None and _is_exact(ground, region, rows):
                break  # freer kinds cannot fit better
        if not grown:
            continue
        region = _outgrown(ground, max(grown, key=lambda region: region.evidence))
        if _is_faceted(ground, region):
            ground.log_types[region.rows] = 0.0
        else:
            regions.append(_take(ground, region))
    return regions


def _is_exact(ground: Ground, region: Region, patch: np.ndarray) -> bool:
    """Whether a region of a clean cloud holds its patch and fits as well as a fit can."""
    full = FULL_EVIDENCE * HANDICAP[region.primitive.kind] * len(region.rows)
    held = np.isin(patch, region.rows).mean()
    return is_quiet(ground.surface) and region.evidence > EXACT * full and bool(held > EXACT)


def _is_faceted(ground: Ground, region: Region) -> bool:
    """Whether planes lie better within a curved region than it does: under noise a hexagon passes for a cylinder.

    A strip of a truly curved surface is as wide as the tolerance lets a plane be wrong, so the plane fits it worse.
    """
    if region.primitive.kind == "plane" or "plane" not in ground.sought:
        return False
    inside = window(ground, region.rows)
    curved, _ = inside.cloud.agreement(region.primitive)
    votes = 0
    seeds = np.linspace(0, len(region.rows) - 1, FACET_SEEDS + 2).astype(int)[1:-1]
    for tried, seed in enumerate(seeds, start=1):
        near = np.argsort(np.square(inside.points - inside.points[seed]).sum(axis=1))[:FACET_POINTS]
        plane = grow(inside, near, "plane")
        if plane is not None:
            flat, _ = inside.cloud.agreement(plane.primitive, plane.rows)
            gain = FULL_EVIDENCE * float(np.sum(np.square(curved[plane.rows]) - np.square(flat))) / ground.tolerance**2
            votes += gain > SIGNIFICANT
        if votes > FACET_SEEDS / 2 or votes + FACET_SEEDS - tried < FACET_SEEDS / 2:
            break
    return votes > FACET_SEEDS / 2


def _take(ground: Ground, region: Region) -> Region:
    """The region with the points beside it that it claims; marks both in the ground."""
    ground.taken[region.rows[ground.surface.core[region.rows]]] = True
    claims = _claim(ground, region)
    ground.claimed[claims] = True
    return Region(np.union1d(region.rows, claims), region.primitive, region.evidence)


def _grow_pass(ground: Ground, open_rows: Bool[np.ndarray, " n"]) -> list[Region]:
    """Regions from every seed among the open rows, deepest first; marks what they take and claim in the ground."""
    points, core = ground.points, ground.surface.core
    seeds = open_rows & core & ~ground.claimed & ~ground.taken
    depth = np.full(len(points), np.inf)
    ends = ~core | ground.taken
    if ends.any():
        depth = KDTree(points[ends]).query(points)[0]
    regions: list[Region] = []
    while seeds.any():
        seed = int(np.argmax(np.where(seeds, depth, -1.0)))
        region = _grow_seed(ground, seed, float(depth[seed]))
        seeds[seed] = False
        if region is None:
            # The seed and its closest surroundings are given up, not only the seed: they would fail alike.
            seeds[ground.surface.index[seed, :NUM_LINKS]] = False
            within = GIVEN_UP * _seed_radius(ground, float(depth[seed]))
            seeds[_within(ground, seed, within)] = False
            continue
        regions.append(_take(ground, region))
        rows = regions[-1].rows
        seeds[rows] = False
        if seeds.any():
            depth[seeds] = np.minimum(depth[seeds], KDTree(points[rows]).query(points[seeds])[0])
    return regions


def _grow_seed(ground: Ground, seed: int, depth: float) -> Region | None:
    """The best of the four kinds grown from one seed, None where none explains enough."""
    patch = _seed_patch(ground, seed, depth)
    if len(patch) < SEED_POINTS[0]:
        return None
    quiet = is_quiet(ground.surface)
    if quiet and _bends_both_ways(ground, patch, seed):
        return None
    best: Region | None = None
    # The likeliest kind first; where nobody knows, the simplest. Under noise the first that grows is taken: evidence
    # of what a small seed became favours the freest kind (competition there cost 2 to 6 points of right types).
    likely = ground.log_types[patch].sum(axis=0)
    for kind in sorted(ground.sought, key=lambda kind: -likely[KINDS.index(kind)]):
        region = grow(ground, patch, kind)
        if region is None:
            continue
        if best is None or region.evidence > best.evidence:
            best = region
        # Without noise a surface of too few degrees of freedom does not outgrow its seed; with noise see below.
        if not quiet or len(region.rows) > 2.5 * len(patch):
            break
    if best is None:
        return None
    region = _outgrown(ground, best)
    if not quiet and _is_faceted(ground, region):
        return grow(ground, patch, "plane")
    return region


def _bends_both_ways(ground: Ground, patch: np.ndarray, seed: int) -> bool:
    """Whether a patch of a clean cloud bends both ways, and not as a sphere does: it is part of a torus or free form.

    What the quadric leaves over, terms of third order, is what its curvatures may be wrong by.
    """
    if len(patch) < MIN_QUADRIC:
        return False
    x, y, z = host.frame_of(ground.surface.normal[seed]) @ (ground.points[patch] - ground.points[seed]).T
    size = float(np.hypot(x, y).max())
    x, y = x / size, y / size
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    found = np.linalg.lstsq(design, z, rcond=None)[0]
    least, most = sorted(np.linalg.eigvalsh([[found[3], found[4] / 2], [found[4] / 2, found[5]]]), key=abs)
    left = float(np.sqrt(np.square(z - design @ found).mean()))
    is_round = least * most > 0.0 and abs(least) > ROUND * abs(most)
    least_bent = max(BENT * abs(most), SURELY_BENT * max(left, ground.tolerance))
    return bool(abs(least) > least_bent and not is_round)


def _outgrown(ground: Ground, region: Region) -> Region:
    """The region, or what another kind makes of it, as long as that explains more."""
    while (better := _regrow(ground, region)) is not None:
        region = better
    return _upright(ground, region)


def _upright(ground: Ground, region: Region) -> Region:
    """A cone that hardly opens as a cylinder, where that fits its points as well."""
    cone = region.primitive
    if not isinstance(cone, Cone) or cone.half_angle > MAX_UPRIGHT or "cylinder" not in ground.sought:
        return region
    own, other = refitted(ground, "cone", region.rows), refitted(ground, "cylinder", region.rows)
    if own is None or other is None:
        return region
    loss = 0.5 * len(region.rows) * (other.rms**2 - own.rms**2) / (ground.tolerance / 3.0) ** 2
    if loss > SIGNIFICANT:
        return region
    distance, _ = ground.cloud.agreement(other.primitive, region.rows)
    return Region(region.rows, other.primitive, evidence_of(ground, "cylinder", region.rows, distance))


def _regrow(ground: Ground, region: Region) -> Region | None:
    """A region of another kind grown from this one's points that explains more; None where there is none.

    Noise hides the curvature of a seed patch, but not that of the strip which the wrong kind has grown from it. Only
    kinds that fit the strip significantly better are tried.
    """
    best = None
    own = refitted(ground, region.primitive.kind, region.rows)
    weight = 0.5 * len(region.rows) / (ground.tolerance / 3.0) ** 2
    if own is None or weight * own.rms**2 < SIGNIFICANT:
        return None
    for kind in ground.sought:
        other = None if kind == region.primitive.kind else refitted(ground, kind, region.rows)
        if other is None or weight * (own.rms**2 - other.rms**2) < SIGNIFICANT:
            continue
        grown = grow(ground, region.rows, kind)
        if grown is not None and grown.evidence > max(region.evidence, best.evidence if best else 0.0):
            best = grown
    return best


def _seed_patch(ground: Ground, seed: int, depth: float) -> np.ndarray:
    """Points around the seed that lie no farther than the nearest edge, within the limits of SEED_POINTS."""
    near = np.flatnonzero(~ground.taken & _within(ground, seed, _seed_radius(ground, depth)))
    if len(near) >= SEED_POINTS[0]:
        return near
    near = ground.surface.index[seed]
    return np.unique(near[~ground.taken[near]])


def _within(ground: Ground, seed: int, radius: float) -> Bool[np.ndarray, " n"]:
    offset = ground.cloud.coordinates - ground.points[seed][:, None]
    return np.einsum("cn,cn->n", offset, offset) <= radius * radius


def _seed_radius(ground: Ground, depth: float) -> float:
    return float(np.clip(0.9 * depth, 2.0 * ground.surface.spacing, _widest_seed(ground.surface)))


def _widest_seed(surface: LocalSurface) -> float:
    """Radius of the largest seed patches, which noise widens."""
    widening = float(np.clip(2.0 * surface.noise / surface.spacing, 1.0, 5.0))
    return surface.spacing * widening * np.sqrt(SEED_POINTS[1] / np.pi)


def _claim(ground: Ground, region: Region) -> np.ndarray:
    """Points beside the region that it explains and reaches within some links, whatever their normals say.

    On a clean cloud only those off the core: there a core point of another normal is on another surface.
    """
    distance, _ = ground.cloud.agreement(region.primitive)
    fits = (distance <= ground.tolerance) & ~ground.taken
    rings = CLAIM_RINGS
    if is_quiet(ground.surface):
        fits &= ~ground.surface.core
    else:
        # As far as the neighbourhood of a normal reaches.
        rings += int(np.sqrt(ground.surface.index.shape[1] / np.pi))
    reached = np.zeros(len(fits), dtype=bool)
    reached[region.rows] = True
    for _ in range(rings):
        open_rows = np.flatnonzero(fits & ~reached)
        beside = reached[ground.links[open_rows]].any(axis=1)
        reached[open_rows[beside]] = True
    return np.flatnonzero(reached & fits)
