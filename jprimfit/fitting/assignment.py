"""Every point to the surface it lies on, and the faces: connected parts of one surface.

A point may belong to the surfaces that its neighbours belong to. It takes the one of least cost: distance in units of
the noise, disagreement of normals where the neighbourhood is smooth, less a bonus for each neighbour that says the
same (iterated conditional modes, Besag 1986). A point on a sharp edge lies on both surfaces; there the surface with
fewer points wins, which loses more by a missing row than a large one. What no surface explains stays -1.
Lengths in the normalised frame. n points, s surfaces, k neighbours.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from jprimfit.fitting import kinds, shapes
from jprimfit.fitting.local import LocalSurface
from jprimfit.fitting.merging import Surface
from jprimfit.primitives.table import MODULES

NUM_VOTERS = 9  # neighbours, the point included, whose surfaces are candidates
SWEEPS = 6
NORMAL_SCALE = np.radians(15.0)  # a disagreement that costs as much as one standard deviation of distance
MAX_TURN = 2.0  # of these at most: beside an edge a normal may be worth nothing
SAME_NEIGHBORS = 1.5  # bonus where all neighbours lie on the surface already
SMALL_SURFACE = 0.25  # cost of each e-fold of a surface's size
MAX_LINK = 3.0  # length of a link, in distances to the farthest of the voters
MAX_DISTANCE = 1.5  # tolerances; a point that lies farther off is not on a surface
UNEXPLAINED = 4.5  # cost of a point that lies on none, that of three standard deviations
SIGNIFICANT = 8.0  # nats that a surface must gain beyond what its parameters cost
CHUNK = 65_536  # points whose votes are compared at a time
MIN_FACE = 6  # points that a face has at least; a smaller part cut off from its surface is none
SPECK = 8.5  # tolerances: radius of a disk below which noise alone can look like a face
SPECK_SHARE = 0.005  # of all points; what is larger is no speck under any noise (as SPFN's smallest segment)


def assign(
    points: Float[np.ndarray, "n 3"],
    surface: LocalSurface,
    surfaces: list[Surface],
    labels: Int[np.ndarray, " n"],
    *,
    tolerance: float,
) -> Int[np.ndarray, " n"]:
    """Surface of every point, -1 = none, starting from labels (n,) of the points that are known already."""
    if not surfaces:
        return np.full(len(points), -1, dtype=np.int32)
    cost = _costs(points, surface, surfaces, tolerance)
    size = np.maximum(np.bincount(labels[labels >= 0], minlength=len(surfaces)), 1)
    cost += SMALL_SURFACE * np.log(size)[:, None]
    voters = surface.index[:, :NUM_VOTERS]
    labels = labels.astype(np.int32)
    for _ in range(SWEEPS):
        updated = _unanimous(cost, labels)
        rows = np.flatnonzero((labels[voters] != labels[:, None]).any(axis=1))
        for start in range(0, len(rows), CHUNK):
            some = rows[start : start + CHUNK]
            votes = labels[voters[some]]
            share = (votes[:, :, None] == votes[:, None, :]).mean(axis=2)
            total = np.where(votes >= 0, cost[votes, some[:, None]] - SAME_NEIGHBORS * share, np.inf)
            best, every = total.argmin(axis=1), np.arange(len(some))
            updated[some] = np.where(np.isfinite(total[every, best]), votes[every, best], -1)
        if np.array_equal(updated, labels):
            break
        labels = updated
    return labels


def _unanimous(cost: Float[np.ndarray, "s n"], labels: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Labels where all voters say the same as the point: kept unless the point is too far away for it."""
    return np.where(np.isfinite(cost[labels, np.arange(len(labels))]), labels, -1)


def linked(points: Float[np.ndarray, "n 3"], surface: LocalSurface) -> Int[np.ndarray, "n l"]:
    """The neighbours that connect each point; the point itself in the place of those that are none by both measures.

    An outlier's neighbours have others much nearer.
    """
    index = surface.index[:, 1:NUM_VOTERS]
    reach = np.sqrt(np.square(points[index[:, -1]] - points).sum(axis=1))
    links = np.empty_like(index)
    for place, beside in enumerate(index.T):
        distance = np.sqrt(np.square(points[beside] - points).sum(axis=1))
        near = distance <= MAX_LINK * np.minimum(reach, reach[beside])
        links[:, place] = np.where(near, beside, np.arange(len(points)))
    return links


def faces(
    links: Int[np.ndarray, "n l"], labels: Int[np.ndarray, " n"], *, min_points: int = MIN_FACE
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " faces"]]:
    """Splits every surface into its connected faces: face of every point (-1 = none), and the surface of every face.

    links: of `linked`. Faces are numbered by falling number of points. Parts of fewer than min_points points become -1.
    """
    inside = (labels[links] == labels[:, None]) & (labels >= 0)[:, None]
    bounds = np.concatenate([[0], np.cumsum(inside.sum(axis=1))])
    matrix = csr_matrix((np.ones(bounds[-1]), links[inside], bounds), shape=(len(labels),) * 2)
    _, component = connected_components(matrix, directed=False)
    component[labels < 0] = -1
    numbers, sizes = np.unique(component[component >= 0], return_counts=True)
    order = np.argsort(-sizes, kind="stable")
    order = order[sizes[order] >= min_points]
    rank = np.full(component.max(initial=-1) + 2, -1)
    rank[numbers[order]] = np.arange(len(order))
    face = rank[component]
    surface_of = np.zeros(len(order), dtype=np.int32)
    surface_of[face[face >= 0]] = labels[face >= 0]
    return face.astype(np.int32), surface_of


def without_specks(
    links: Int[np.ndarray, "n l"],
    surface: LocalSurface,
    labels: Int[np.ndarray, " n"],
    *,
    tolerance: float,
    min_points: int = MIN_FACE,
) -> Int[np.ndarray, " n"]:
    """The labels with -1 on faces so small that they may be noise, or of fewer points than are asked for.

    assign then asks what lies around them.
    """
    face, _ = faces(links, labels)
    size = np.append(np.bincount(face[face >= 0], minlength=1), 0)[face]
    smallest = min(surface.num_in_disk(SPECK * tolerance), SPECK_SHARE * len(labels))
    return np.where(size < max(smallest, min_points), -1, labels).astype(np.int32)


def without_needless(
    points: Float[np.ndarray, "n 3"],
    surface: LocalSurface,
    surfaces: list[Surface],
    links: Int[np.ndarray, "n l"],
    labels: Int[np.ndarray, " n"],
    *,
    tolerance: float,
) -> Int[np.ndarray, " n"]:
    """The labels with -1 on surfaces whose points the surfaces around them explain nearly as well.

    A few points from either side of an edge make a surface of their own. One has to explain its points better by what
    its parameters cost (G. Schwarz 1978); the smallest is judged first, and those that stay judge the others.
    """
    cloud, labels = kinds.Cloud(points, surface.normal), labels.copy()
    for number in np.argsort(np.bincount(labels[labels >= 0], minlength=len(surfaces)), kind="stable"):
        rows = np.flatnonzero(labels == number)
        around = np.setdiff1d(labels[links[rows]], [-1, number])
        if not len(rows) or not len(around):
            continue
        own, *others = (_cost(cloud, surface, surfaces[one], rows, tolerance) for one in (number, *around))
        gain = float(np.sum(np.min([np.full(len(rows), UNEXPLAINED), *others], axis=0) - np.minimum(own, UNEXPLAINED)))
        freedom = MODULES[surfaces[number].primitive.kind].NUM_FREEDOM
        if gain < SIGNIFICANT + 0.5 * freedom * np.log(len(rows)):
            labels[rows] = -1
    return labels


def _costs(points, surface, surfaces, tolerance) -> Float[np.ndarray, "s n"]:
    cloud = kinds.Cloud(points, surface.normal)
    cost = np.full((len(surfaces), len(points)), np.inf, np.float32)
    for number, candidate in enumerate(surfaces):
        distance = np.abs(shapes.signed_distances(candidate.primitive, cloud.coordinates))
        near = np.flatnonzero(distance <= MAX_DISTANCE * tolerance)
        cost[number, near] = _cost(cloud, surface, candidate, near, tolerance)
    return cost


def _cost(cloud: kinds.Cloud, surface: LocalSurface, candidate: Surface, rows: np.ndarray, tolerance: float):
    """Nats that it costs some points to lie on a surface."""
    distance, cosine = cloud.agreement(candidate.primitive, rows)
    turn = np.minimum(np.arccos(np.minimum(cosine, 1.0)) / NORMAL_SCALE, MAX_TURN)
    return 0.5 * np.square(3.0 * distance / tolerance) + 0.5 * np.square(turn) * surface.core[rows]
