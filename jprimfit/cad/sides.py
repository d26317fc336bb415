"""On which side of each primitive the material is: what tells a hole from a boss.

A patch bears its primitive's own normals, so one sign per patch says all. Where two patches meet, the boundaries of a
surface that is turned outwards all over run against each other: every shared edge relates two signs, the longer and
the clearer the more. The relations are followed along the strongest (a spanning tree, as H. Hoppe et al. (1992) do for
points) and mended where most speak against. That leaves one sign for each group of patches that hang together. It is
found from the flux through the surface: by the divergence theorem the volume inside is positive, and half of a closed
surface is seen from a point on it. Where the surface is open and these do not tell, the sign is 0. p patches.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import KDTree

from jprimfit.cad.patches import Patch, boundary_edges

TOUCHING = 1.5  # median boundary edges within which two boundaries are one
NUM_NEAREST = 24  # boundary edges that are searched for one of another patch
CLEAR = 0.5  # cosine between boundaries that relates two patches
SUPPORT = 0.3  # of the boundary that must speak for a sign on balance
SMALL_OPENING = 0.5  # (length of open edges)^2 over area, below which a surface counts as closed
FEW_OPEN, BALANCED = 0.4, 0.1  # so does one with so few open edges whose areas so nearly sum to zero
MAX_OPEN_EDGES = 0.5  # of all boundary edges of a group that stands on a table
MAX_OPEN = 0.9  # area of its base, over that of its surface
MAX_ALONG = 0.5  # cosine between the base and the surface at its edge, in the mean
EVIDENT = 2.0  # volume inside over how far it depends on where the base is put
MIN_FLUX = 0.05  # by which the two signs of a group must differ, in squared turns of the solid angle
NUM_PLACES = 8  # from which a group's flux is looked at
MAX_ANGLES = 500_000  # solid angles that are computed for all groups together


class _Rims(NamedTuple):
    """The boundary edges of all patches together, e of them."""

    middle: Float64[np.ndarray, "e 3"]
    step: Float64[np.ndarray, "e 3"]  # from start to end, the surface on its left
    normal: Float64[np.ndarray, "e 3"]  # of the surface there
    patch: Int[np.ndarray, "e"]
    partner: Int[np.ndarray, "e"]  # the nearest edge of another patch where the two are one, else -1


def outward(patches: Sequence[Patch]) -> Int[np.ndarray, "p"]:
    """+1 where a patch's normals lead out of the material, -1 where they lead into it, 0 where that is not known."""
    patches = _at_unit_scale(patches)
    rims = _rims(patches)
    relation, shared = _relations(rims, len(patches))
    signs, group = _followed(relation, shared)
    _mend(signs, relation)
    support = np.sum(relation * signs[:, None] * signs[None, :], axis=1)
    doubtful = (support < SUPPORT * shared.sum(axis=1)) & (shared.sum(axis=1) > 0)
    signs = signs * _group_signs(patches, rims, signs, group)
    signs[doubtful] = 0
    return signs


def _at_unit_scale(patches: Sequence[Patch]) -> list[Patch]:
    """The patches shifted and divided by their size: no sign hangs on it, and volumes of huge parts leave float64."""
    corners = [
        bound for patch in patches if len(patch.vertices) for bound in (patch.vertices.min(0), patch.vertices.max(0))
    ]
    if not corners:
        return list(patches)
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    size = float(np.max(high - low)) or 1.0
    return [patch._replace(vertices=(patch.vertices - low) / size) for patch in patches]


def _rims(patches: Sequence[Patch]) -> _Rims:
    starts, steps, normals, owner, width = ([np.zeros((0, 3))] for _ in range(5))
    for i, patch in enumerate(patches):
        edges = boundary_edges(patch)
        step = patch.vertices[edges[:, 1]] - patch.vertices[edges[:, 0]]
        starts.append(patch.vertices[edges[:, 0]])
        steps.append(step)
        normals.append(patch.normals[edges[:, 0]])
        length = np.sqrt(np.sum(step**2, axis=1))
        typical = np.median(length) if len(length) else 0.0
        owner.append(np.tile([i, 0, 0], (len(edges), 1)))
        width.append(np.tile([typical, 0, 0], (len(edges), 1)))
    step, own, width = np.concatenate(steps), np.concatenate(owner)[:, 0].astype(int), np.concatenate(width)[:, 0]
    middle = np.concatenate(starts) + step / 2
    partner = np.full(len(middle), -1)
    if len(middle) > 1:
        found = KDTree(middle).query(middle, k=min(NUM_NEAREST, len(middle)))
        distance, row = np.asarray(found[0]), np.asarray(found[1])
        every, column = np.arange(len(middle)), np.argmax(own[row] != own[:, None], axis=1)
        other, apart = row[every, column], distance[every, column]
        meets = (own[other] != own) & (apart < TOUCHING * np.maximum(width, width[other]))
        partner[meets] = other[meets]
    return _Rims(middle, step, np.concatenate(normals), own, partner)


def _relations(rims: _Rims, num: int) -> tuple[Float64[np.ndarray, "p p"], Float64[np.ndarray, "p p"]]:
    """Length of the boundary two patches share, signed: positive if equal signs turn both outwards; and unsigned."""
    relation, shared = np.zeros((num, num)), np.zeros((num, num))
    one = np.flatnonzero(rims.partner >= 0)
    two = rims.partner[one]
    length = np.sqrt(np.sum(rims.step**2, axis=1))
    against = -np.sum(rims.step[one] * rims.step[two], axis=1) / np.maximum(length[two], np.finfo(float).tiny)
    np.add.at(relation, (rims.patch[one], rims.patch[two]), against)
    np.add.at(shared, (rims.patch[one], rims.patch[two]), length[one])
    return relation + relation.T, shared + shared.T


def _followed(
    relation: Float64[np.ndarray, "p p"], shared: Float64[np.ndarray, "p p"]
) -> tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]]:
    """Signs relative to the first patch of each group, along the clearest relations, and the group of each patch."""
    clear = np.divide(np.abs(relation), shared, out=np.zeros_like(shared), where=shared > 0)
    weight = np.where(clear >= CLEAR, np.abs(relation) * clear**2, 0.0)
    cost = np.divide(1.0, weight, out=np.zeros_like(weight), where=weight > 0)
    tree = minimum_spanning_tree(coo_array(cost))
    tree = (tree + tree.T).tocsr()
    num_groups, group = connected_components(tree, directed=False)
    signs = np.ones(len(relation), np.int64)
    for number in range(num_groups):
        order, before = breadth_first_order(tree, int(np.argmax(group == number)), directed=False)
        for row in order[1:]:
            signs[row] = signs[before[row]] * (1 if relation[row, before[row]] > 0 else -1)
    return signs, group.astype(np.int64)


def _mend(signs: Int[np.ndarray, "p"], relation: Float64[np.ndarray, "p p"]) -> None:
    """Turns over, in place, the patch that most boundary speaks against, until none is left."""
    for _ in range(2 * len(signs)):
        support = signs * (relation @ signs)
        worst = int(np.argmin(support)) if len(signs) else 0
        if not len(signs) or support[worst] >= 0:
            return
        signs[worst] *= -1


def _group_signs(
    patches: Sequence[Patch], rims: _Rims, signs: Int[np.ndarray, "p"], group: Int[np.ndarray, "p"]
) -> Int[np.ndarray, "p"]:
    """For every patch the sign of its group: the largest by its volume, the others by what is seen from them."""
    triangles = [patch.vertices[patch.faces] for patch in patches]
    size = np.array([np.sum(np.sqrt(np.sum(_areas(t) ** 2, axis=1))) for t in triangles])
    total = np.bincount(group, weights=size, minlength=1)
    found = np.zeros(len(total), np.int64)
    settled: list[np.ndarray] = []
    num_faces = sum(len(t) for t in triangles)
    num_places = int(np.clip(MAX_ANGLES / max(num_faces * len(total), 1), 1, NUM_PLACES))
    for number in np.argsort(-total, kind="stable").tolist():
        members = [i for i in np.flatnonzero(group == number).tolist() if len(triangles[i])]
        if not members:
            continue
        # Faces of patches to be turned over have their corners in the other order.
        mine = np.concatenate([triangles[i][:, :: int(signs[i])] for i in members])
        if settled:
            found[number] = _sign_by_sight(mine, np.concatenate(settled), num_places)
        else:
            found[number] = _sign_by_volume(mine, rims, np.flatnonzero(np.isin(rims.patch, members)))
        if found[number]:
            settled.append(mine[:, :: int(found[number])])
    return found[group]


def _sign_by_volume(triangles: Float64[np.ndarray, "f 3 3"], rims: _Rims, rows: Int[np.ndarray, "r"]) -> int:
    """The sign of the volume inside, an opening being closed by a plane; 0 where that is not what it looks like.

    rows: the group's edges in rims. A part that stands on a table lacks its base: the open edges lie in one plane, and
    the surface runs up to it across, not along it, as the surroundings of a pocket do. A tube alone may be either.
    """
    area = _areas(triangles)
    size = float(np.sum(np.sqrt(np.sum(area**2, axis=1))))
    length = np.sqrt(np.sum(rims.step[rows] ** 2, axis=1))
    is_open = rims.partner[rows] < 0
    opening, edges = rows[is_open], length[is_open]
    missing = area.sum(axis=0)  # 0 for a closed surface: what misses is at least as large
    middle = triangles.mean(axis=1)
    lack, share_open = float(np.sqrt(missing @ missing)), edges.sum() / max(length.sum(), np.finfo(float).tiny)
    if edges.sum() ** 2 < SMALL_OPENING * size or (share_open < FEW_OPEN and lack < BALANCED * size):
        return int(np.sign(np.sum((middle - middle.mean(axis=0)[None, :]) * area)))
    share = edges / edges.sum()
    place = share @ rims.middle[opening]
    along = np.abs(rims.normal[opening] @ missing) / max(lack, np.finfo(float).tiny)
    if share_open > MAX_OPEN_EDGES or lack > MAX_OPEN * size or share @ along > MAX_ALONG:
        return 0
    volume = np.sum((middle - place[None, :]) * area) / 3
    uneven = np.sqrt(share @ ((rims.middle[opening] - place[None, :]) @ missing / 3) ** 2)
    return int(np.sign(volume)) if abs(volume) > EVIDENT * uneven else 0


def _areas(triangles: Float64[np.ndarray, "f 3 3"]) -> Float64[np.ndarray, "f 3"]:
    """Normals as long as the triangles' areas."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) / 2


def _sign_by_sight(mine: Float64[np.ndarray, "f 3 3"], others: Float64[np.ndarray, "g 3 3"], num_places: int) -> int:
    """The sign with which, from points of `mine`, the whole surface fills half of all directions; 0 if both do."""
    order = np.cumsum(np.sqrt(np.sum(_areas(mine) ** 2, axis=1)))
    rows = np.searchsorted(order, order[-1] * (np.arange(num_places) + 0.5) / num_places)
    places = mine[np.minimum(rows, len(mine) - 1)].mean(axis=1)
    own, rest = winding(places, mine), winding(places, others)
    wrong = [float(np.mean((sign * own + rest - 0.5) ** 2)) for sign in (1, -1)]
    if abs(wrong[0] - wrong[1]) < MIN_FLUX:
        return 0
    return 1 if wrong[0] < wrong[1] else -1


def winding(places: Float64[np.ndarray, "m 3"], triangles: Float64[np.ndarray, "f 3 3"]) -> Float64[np.ndarray, "m"]:
    """Signed share of all directions in which the triangles' backs are seen from each place: 1 inside, 0 outside.

    The solid angle of a triangle is that of A. van Oosterom and J. Strackee (1983); one that holds the place counts 0.
    """
    share = np.zeros(len(places))
    for i, place in enumerate(places):
        a, b, c = np.moveaxis(triangles - place[None, None, :], 1, 0)
        la, lb, lc = (np.sqrt(np.einsum("fx,fx->f", v, v)) for v in (a, b, c))
        ab, bc, ca = (np.einsum("fx,fx->f", v, w) for v, w in ((a, b), (b, c), (c, a)))
        volume = np.einsum("fx,fx->f", a, np.cross(b, c))
        angle = 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
        flat = np.abs(volume) <= 1e-12 * la * lb * lc
        share[i] = np.sum(np.where(flat, 0.0, angle)) / (4 * np.pi)
    return share
