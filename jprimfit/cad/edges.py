"""Where the faces around a face cut its surface: edges of a part are intersections of surfaces, not where points end.

The points next to another face tell which face that is and on which side of its surface this face lies. There the
signed distance to that surface takes the place of what the points say of the boundary (patches.py), within bounds, and
vertices on the boundary are moved onto the intersection. Faces that meet smoothly, such as a fillet and a plane, have
none that could be told, and points of no surface have none: there the boundary stays where the points end.
Host code, float64. v vertices.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.spatial import KDTree

from jprimfit.cad import charts
from jprimfit.types import Primitive

NUM_AROUND = 8  # nearest points, the point included, of which one lies on another face: the point is beside an edge
NUM_ALIKE = 4  # of them on no face, from which on that is a place without a surface and not a stray point
ONE_SIDE = 0.8  # of a face's points near another one that lie on one side of its surface
STEEP = 0.25  # distance from the other surface over that from its points: sine of the angle at which the two meet
NEWTON_STEPS = 4
MOST_BLUR = 4.0  # standard deviations of noise by which an edge may lie off where the points end


class Beside(NamedTuple):
    """The points beside edges, and whose they are."""

    points: Float64[np.ndarray, "m 3"]
    face: Int[np.ndarray, " m"]  # -1 = of none
    primitives: Sequence[Primitive]


class Cut(NamedTuple):
    """The surfaces that cut a face, c of them."""

    surfaces: tuple[Primitive, ...]
    trees: tuple[KDTree, ...]  # of the points of each that lie beside edges
    side: Int[np.ndarray, " c"]  # of each surface, on which the face lies: -1 or 1
    both: Bool[np.ndarray, "c c"]  # where two are near, the face lies on that side of both: it has a corner there
    rest: KDTree | None  # points of other faces, which cut nothing
    within: float  # length from its points up to which a surface counts

    def nearest(self, places: Float[np.ndarray, "v 3"]) -> tuple[Float64[np.ndarray, " v"], Int[np.ndarray, " v"]]:
        """Signed distance of each place to the surface that cuts there, positive on the face's side, and which it is.

        NaN and -1 where none is near, or what cuts nothing is nearer.
        """
        distance = np.stack([_distance(tree, places, self.within) for tree in self.trees])
        height = np.full(distance.shape, np.inf)
        for number, (surface, side) in enumerate(zip(self.surfaces, self.side.tolist(), strict=True)):
            rows = np.isfinite(distance[number])
            height[number, rows] = side * charts.signed_distances(surface, places[rows])
        if self.rest is not None:
            height[:, _distance(self.rest, places, self.within) < distance.min(axis=0)] = np.inf
        first = distance.argmin(axis=0)
        height[~self.both[first].T] = np.inf
        cutting = height.argmin(axis=0)
        least = height[cutting, np.arange(len(places))]
        is_near = np.isfinite(least)
        return np.where(is_near, least, np.nan), np.where(is_near, cutting, -1)


def beside(
    primitives: Sequence[Primitive], points: Float[np.ndarray, "n 3"], labels: Int[np.ndarray, " n"]
) -> Beside | None:
    """The points that have one of another label among their neighbours; None where there is no other."""
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(rows) <= NUM_AROUND or len(np.unique(labels[rows])) < 2:
        return None
    points, labels = np.asarray(points[rows], np.float64), labels[rows]
    around = KDTree(points).query(points, k=NUM_AROUND, workers=-1)[1]
    alike = (labels[around] == labels[:, None]).sum(axis=1)
    rim = (alike < NUM_AROUND) & ((labels >= 0) | (alike >= NUM_ALIKE))
    return Beside(points[rim], labels[rim], primitives)


def cut(number: int, feet: Float64[np.ndarray, "n 3"], around: Beside | None, *, within: float) -> Cut | None:
    """What cuts face `number`, of which feet are the points; None where nothing does. within: as in Cut."""
    if around is None:
        return None
    low, high = feet.min(axis=0) - 2 * within, feet.max(axis=0) + 2 * within
    rows = (around.face != number) & ((around.points >= low) & (around.points <= high)).all(axis=1)
    if not rows.any():
        return None
    points, face = around.points[rows], around.face[rows]
    faces = np.unique(face[face >= 0])
    trees = [KDTree(points[face == other]) for other in faces]
    distance = np.array([_distance(tree, feet, within) for tree in trees]).reshape(-1, len(feet))
    near = np.isfinite(distance)
    height = np.zeros(near.shape)
    for number, other in enumerate(faces):
        height[number, near[number]] = charts.signed_distances(around.primitives[int(other)], feet[near[number]])
    side = np.where(height.sum(axis=1) > 0, 1, -1)
    inside = height * side[:, None] > 0
    steep = np.abs(height).sum(axis=1) >= STEEP * np.where(near, distance, 0.0).sum(axis=1)
    used = np.flatnonzero(steep & near.any(axis=1) & (inside.sum(axis=1) >= ONE_SIDE * near.sum(axis=1)))
    if not len(used):
        return None
    near, inside = near[used].astype(float), inside[used].astype(float)
    both = inside @ inside.T >= ONE_SIDE * (near @ near.T)
    surfaces = tuple(around.primitives[int(other)] for other in faces[used])
    others = points[~np.isin(face, faces[used])]
    rest = KDTree(others) if len(others) else None
    return Cut(surfaces, tuple(trees[one] for one in used), side[used], both, rest, within)


def _distance(tree: KDTree, places: Float[np.ndarray, "v 3"], within: float) -> Float64[np.ndarray, " v"]:
    return tree.query(places, distance_upper_bound=within)[0]


def bounded(
    field: Float64[np.ndarray, " v"], places: Float64[np.ndarray, "v 3"], by: Cut, *, beyond: float
) -> Float64[np.ndarray, " v"]:
    """The field, positive inside, with the surfaces that cut as its zero where they are near.

    field: about the length to where the points end. beyond: how far the face may go on there up to a cut.
    """
    height, _ = by.nearest(places)
    return np.where(np.isnan(height), field, np.minimum(height, field + beyond))


def sharpened(
    primitive: Primitive, vertices: Float64[np.ndarray, "v 3"], rim: Bool[np.ndarray, " v"], by: Cut, *, cell: float
) -> tuple[Float64[np.ndarray, "v 3"], Int[np.ndarray, " v"]]:
    """The vertices, those of the rim moved onto the intersections they lie beside, and with which of by (-1 = none)."""
    vertices, edge = vertices.copy(), np.full(len(vertices), -1)
    edge[rim] = by.nearest(vertices[rim])[1]
    for number, surface in enumerate(by.surfaces):
        rows = np.flatnonzero(edge == number)
        moved, is_there = intersection((primitive, surface), vertices[rows], within=cell)
        vertices[rows[is_there]], edge[rows[~is_there]] = moved[is_there], -1
    return vertices, edge


def intersection(
    surfaces: Sequence[Primitive], places: Float64[np.ndarray, "v 3"], *, within: float
) -> tuple[Float64[np.ndarray, "v 3"], Bool[np.ndarray, " v"]]:
    """The places moved onto two or three surfaces by Newton steps of least length, and which of them came there."""
    at, exact = places.copy(), 1e-6 * within + 1e-12 * max(float(np.abs(places).max(initial=0.0)), within)
    for step in range(NEWTON_STEPS + 1):
        height = np.stack([charts.signed_distances(surface, at) for surface in surfaces], axis=1)
        if step == NEWTON_STEPS or np.abs(height).max(initial=0.0) <= exact:
            break
        normal = np.stack([charts.normals(surface, at) for surface in surfaces], axis=1)
        gram = np.einsum("vix,vjx->vij", normal, normal) + 1e-12 * np.eye(len(surfaces))[None]
        at = at - np.einsum("vix,vi->vx", normal, np.linalg.solve(gram, height[:, :, None])[:, :, 0])
    moved = np.sqrt(np.sum((at - places) ** 2, axis=1))
    return at, (np.abs(height).max(axis=1, initial=0.0) <= exact) & (moved <= within)
