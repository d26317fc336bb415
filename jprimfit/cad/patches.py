"""Patches: the surface of a primitive trimmed to the points of its segment, as a triangle mesh.

Occupancy is measured on the surface itself, so that nothing has a seam: every vertex of a mesh around the points
(cad/charts.py) knows its distance to the nearest point. The part nearer than a reach R is what discs around the
points cover; taking a rim of R minus a little off again is the morphological closing of E. Matheron's school: gaps
between samples close, holes in which a disc of radius R fits stay open, edges come back to where the points end. The
boundary is a level line through the triangles (marching triangles), hence no staircase. Where another face begins the
surfaces' intersection is the boundary (cad/edges.py). Host code, float64.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jprimfit.cad import charts, edges
from jprimfit.types import Primitive

CELL = 2.0  # edge length of a cell of occupancy, in spacings
# In a random sample of 10^4 points a disc of 4 spacings stays empty in two places, one of 5 in none.
REACH = 2.5  # R in cells
PITCH = 1.2  # edge length of the mesh, in cells
NARROW = 1.5  # median distances of a face's points to its edges: longest edge of the mesh, so that no strip is missed
FINEST = 0.2  # cells, shortest
RIM = 0.5  # how far the patch may reach beyond its outermost points, in cells: makes areas unbiased
MAX_VERTICES = 60_000  # of the mesh around one segment; coarser cells beyond that
MAX_SAMPLES = 4_096  # points whose spacing is measured
NUM_NEIGHBORS = 8
# Cut edges are cut no closer to their ends than this fraction: no slivers.
CUT = 0.05


class Patch(NamedTuple):
    """A trimmed primitive; all arrays are empty where there is nothing to show."""

    vertices: Float64[np.ndarray, "v 3"]  # on the primitive, to rounding
    faces: Int[np.ndarray, "f 3"]  # int32, counter-clockwise seen from where the normals point to
    normals: Float64[np.ndarray, "v 3"]  # unit: the plane's own, or away from centre or axis
    edge: Int[np.ndarray, " v"] | None = None  # which of the surfaces that cut it, -1 = none; None = none does


def patch(
    primitive: Primitive,
    points: Float[np.ndarray, "n 3"],
    *,
    spacing: float | None = None,
    max_vertices: int = MAX_VERTICES,
    number: int = -1,
    around: edges.Beside | None = None,
) -> Patch:
    """The surface of a primitive where points of its segment lie.

    No vertex is further than 2.5 cells (5 spacings) from the foot of a point; holes wider than 5 cells stay open;
    specks of one or two stray points are left out. Fewer than 3 different points, or parameters that are not finite,
    give an empty patch.

    Args:
        primitive: in the frame of the points.
        points: of the segment, in any unit; those with non-finite coordinates are ignored.
        spacing: median distance of a point to its nearest neighbour, length. Default: measured on this segment from
            the distance to the 8th neighbour, which line scans, grids and repeated points do not mislead.
        max_vertices: of the mesh that is trimmed; where cells of two spacings would need more, they are enlarged.
        number: of this face among those of around.
        around: the points beside edges, where other faces cut this one.
    """
    points = np.asarray(points, np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    parameters = np.concatenate([np.ravel(np.asarray(value, np.float64)) for value in primitive])
    if len(points) < 3 or not np.isfinite(parameters).all():
        return _empty()
    feet = charts.feet(primitive, points)
    tree = KDTree(feet)
    spacing = sample_spacing(feet) if spacing is None else float(spacing)
    size = float(np.ptp(feet, axis=0).max())
    if not spacing > 1e-9 * size or not np.isfinite(feet).all():
        return _empty()
    # A random sample of n points needs 0.8 n vertices at this pitch: larger cells at once where that is too many.
    cell = CELL * spacing * max(1.0, np.sqrt(0.8 * len(feet) / max_vertices))
    by = edges.cut(number, feet, around, within=REACH * cell)
    half_width = np.inf if by is None else float(np.median(np.nan_to_num(by.nearest(feet)[0], nan=np.inf)))
    while True:
        reach = REACH * cell
        pitch = min(PITCH * cell, max(NARROW * half_width, FINEST * cell))
        surface = charts.mesh(primitive, feet, pitch=pitch, border=reach + 2 * pitch, max_vertices=max_vertices)
        if surface is not None:
            break
        cell *= 1.2
    field = _closing(surface, tree, reach=reach, rim=RIM * CELL * spacing)
    if by is not None:
        blur = float(np.sqrt(np.mean(np.sum((points - feet) ** 2, axis=1))))
        field = edges.bounded(field, surface.vertices, by, beyond=cell + edges.MOST_BLUR * blur)
    cut = _without_specks(_clipped(surface, field), smallest=8 * spacing**2)
    vertices = charts.feet(primitive, cut.vertices)
    found = Patch(vertices, cut.faces, charts.normals(primitive, vertices))
    return found if by is None else _sharpened(primitive, found, by, cell=cell)


def of_faces(
    primitives: Sequence[Primitive], points: Float[np.ndarray, "n 3"], labels: Int[np.ndarray, " n"]
) -> tuple[Patch, ...]:
    """The patch of every face of a cloud, trimmed to its points and by the faces around it; labels: -1 = none."""
    points = np.asarray(points, np.float64)
    around = edges.beside(primitives, points, labels)
    return tuple(
        patch(primitive, points[labels == number], number=number, around=around)
        for number, primitive in enumerate(primitives)
    )


def area(patch: Patch) -> float:
    """Sum of the areas of the triangles, squared unit of the vertices."""
    return float(_triangle_areas(patch.vertices, patch.faces).sum())


def sample_spacing(points: Float[np.ndarray, "n 3"]) -> float:
    """The median nearest-neighbour distance that a random surface sample of the points' density has.

    From the distance to the k-th neighbour d_k (k = 8): pi d_k^2 x density is about k - 1/3 in the median, and
    ln 2 for the nearest. The 0.9 quantile, 1.24 medians in a random sample, stands for the median: a scan that gets
    sparser with distance must hold together at its far end. 0 where there are too few different points.
    """
    points = np.asarray(points, np.float64)
    k = min(NUM_NEIGHBORS, len(points) - 1)
    if k < 1:
        return 0.0
    queries = points[:: -(-len(points) // MAX_SAMPLES)]
    distance, _ = KDTree(points).query(queries, k=k + 1)
    return float(np.quantile(distance[:, k], 0.9) / 1.24 * np.sqrt(np.log(2.0) / (k - 1 / 3)))


def components(patch: Patch) -> list[Patch]:
    """The connected pieces of a patch, largest first."""
    labels, areas = _component_areas(patch.vertices, patch.faces)
    pieces = []
    for label in np.argsort(-areas, kind="stable"):
        vertices, faces, rows = _compact(patch.vertices, patch.faces[labels == label])
        pieces.append(Patch(vertices, faces, patch.normals[rows], None if patch.edge is None else patch.edge[rows]))
    return pieces


def boundary_edges(patch: Patch) -> Int[np.ndarray, "e 2"]:
    """The directed edges of one face only, the surface on their left seen from where the normals point to."""
    start = patch.faces.astype(np.int64)
    pairs = np.stack([start, np.roll(start, -1, axis=1)], axis=2).reshape(-1, 2)
    low, high = pairs.min(axis=1), pairs.max(axis=1)
    _, inverse, count = np.unique(low * len(patch.vertices) + high, return_inverse=True, return_counts=True)
    return pairs[count[inverse.ravel()] == 1]


def boundary_loops(patch: Patch) -> list[Int[np.ndarray, "k"]]:
    """Closed chains of boundary vertices (rows of patch.vertices), the surface on their left seen from outside.

    Outer outlines turn counter-clockwise about the normals, holes clockwise. Two chains that touch in one vertex are
    separated there.
    """
    following: dict[int, list[int]] = {}
    for start, end in boundary_edges(patch).tolist():
        following.setdefault(start, []).append(end)
    loops = []
    while following:
        first = next(iter(following))
        chain, place = [first], {first: 0}
        while True:
            ends = following[chain[-1]]
            vertex = ends.pop()
            if not ends:
                del following[chain[-1]]
            if vertex in place:
                # A vertex met again closes a loop; what led there goes on as its own chain.
                start = place[vertex]
                loops.append(np.array(chain[start:], np.int64))
                for passed in chain[start + 1 :]:
                    del place[passed]
                chain = chain[: start + 1]
                if vertex not in following:
                    break
            else:
                place[vertex] = len(chain)
                chain.append(vertex)
    return loops


def _sharpened(primitive: Primitive, found: Patch, by: edges.Cut, *, cell: float) -> Patch:
    """The patch with its boundary on the intersections, and corners where two of them meet."""
    boundary = boundary_edges(found)
    rim = np.zeros(len(found.vertices), bool)
    rim[boundary] = True
    vertices, edge = edges.sharpened(primitive, found.vertices, rim, by, cell=cell)
    while (folded := _folded(vertices, found) & (edge[found.faces] >= 0).any(axis=1)).any():
        rows = np.unique(found.faces[folded])
        vertices[rows], edge[rows] = found.vertices[rows], -1
    faces = found.faces
    one, two = edge[boundary].T
    meeting = np.sort(edge[boundary[(one >= 0) & (two >= 0) & (one != two)]], axis=1)
    for first, second in np.unique(meeting, axis=0):
        rows = boundary[(np.sort(edge[boundary], axis=1) == [first, second]).all(axis=1)]
        surfaces = (primitive, by.surfaces[int(first)], by.surfaces[int(second)])
        corner, is_there = edges.intersection(surfaces, vertices[rows].mean(axis=1), within=cell)
        a, b = vertices[rows[:, 0]], vertices[rows[:, 1]]
        turn = np.sum(np.cross(a - b, corner - b) * found.normals[rows[:, 0]], axis=1)
        is_there &= turn > 0  # a corner that the triangles enclose already would fold them
        new = len(vertices) + np.arange(is_there.sum())
        faces = np.concatenate([faces, np.column_stack([rows[is_there][:, ::-1], new]).astype(np.int32)])
        vertices = np.concatenate([vertices, corner[is_there]])
        edge = np.concatenate([edge, np.full(len(new), first)])
    return Patch(vertices, faces, charts.normals(primitive, vertices), edge)


def _folded(vertices: Float64[np.ndarray, "v 3"], before: Patch) -> Bool[np.ndarray, " f"]:
    """The faces that turn over where the vertices are moved."""
    a, b, c = (vertices[before.faces[:, i]] for i in range(3))
    return np.sum(np.cross(b - a, c - a) * before.normals[before.faces].sum(axis=1), axis=1) < 0


def _closing(surface: charts.Mesh, tree: KDTree, *, reach: float, rim: float) -> Float64[np.ndarray, "v"]:
    """A function of the vertices that is positive inside the closed patch, about a length, zero on its boundary."""
    pairs = charts.edges(surface.faces)[0]
    ends = surface.vertices[pairs]
    longest = float(np.sqrt(np.max(np.sum((ends[:, 0] - ends[:, 1]) ** 2, axis=1))))
    # Beyond the reach and an edge no exact distance is needed: the search gives up early and says infinity.
    distance = tree.query(surface.vertices, distance_upper_bound=reach + 2 * longest)[0]
    inside = distance < reach
    crossing = pairs[inside[pairs[:, 0]] != inside[pairs[:, 1]]]
    sign = np.where(inside, 1.0, -1.0)
    if len(crossing) == 0:
        return sign * reach
    start, end = distance[crossing].T
    share = ((reach - start) / (end - start))[:, None]
    rim_points = (1 - share) * surface.vertices[crossing[:, 0]] + share * surface.vertices[crossing[:, 1]]
    depth = KDTree(rim_points).query(surface.vertices, distance_upper_bound=reach + 2 * longest)[0]
    return sign * np.minimum(depth, reach + 2 * longest) - (reach - rim)


def _clipped(surface: charts.Mesh, field: Float64[np.ndarray, "v"]) -> charts.Mesh:
    """The part of the mesh where the linearly interpolated field is positive."""
    inside = field > 0
    pairs, of_face = charts.edges(surface.faces)
    cut = inside[pairs[:, 0]] != inside[pairs[:, 1]]
    start, end = field[pairs[cut]].T
    share = np.clip(start / (start - end), CUT, 1 - CUT)[:, None]
    added = (1 - share) * surface.vertices[pairs[cut, 0]] + share * surface.vertices[pairs[cut, 1]]
    row = np.full(len(pairs), -1)
    row[cut] = len(surface.vertices) + np.arange(cut.sum())
    state = inside[surface.faces]
    num_inside = state.sum(axis=1)
    parts = [surface.faces[num_inside == 3]]
    for corner in range(3):
        # Faces turned so that the odd corner out comes first; edge i runs from corner i to corner i + 1.
        a, b, c = (surface.faces[:, (corner + i) % 3] for i in range(3))
        ab, ca = row[of_face[:, corner]], row[of_face[:, (corner + 2) % 3]]
        tip = (num_inside == 1) & state[:, corner]
        parts.append(np.stack([a, ab, ca], axis=1)[tip])
        stump = (num_inside == 2) & ~state[:, corner]
        parts.append(np.stack([ab, b, c], axis=1)[stump])
        parts.append(np.stack([ab, c, ca], axis=1)[stump])
    vertices, faces, _ = _compact(np.concatenate([surface.vertices, added]), np.concatenate(parts))
    return charts.Mesh(vertices, faces)


def _without_specks(surface: charts.Mesh, *, smallest: float) -> charts.Mesh:
    """Leaves out pieces of less area than `smallest`, but never the largest."""
    if len(surface.faces) == 0:
        return surface
    labels, areas = _component_areas(surface.vertices, surface.faces)
    keep = areas >= min(smallest, areas.max())
    vertices, faces, _ = _compact(surface.vertices, surface.faces[keep[labels]])
    return charts.Mesh(vertices, faces)


def _component_areas(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The piece of each face, numbered without gaps, and the area of each piece."""
    if len(faces) == 0:
        return np.zeros(0, np.int64), np.zeros(0)
    start, end = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_array((np.ones(len(start), bool), (start, end)), shape=(len(vertices),) * 2)
    label = connected_components(links, directed=False)[1][faces[:, 0]]
    label = np.unique(label, return_inverse=True)[1]
    return label, np.bincount(label, _triangle_areas(vertices, faces))


def _triangle_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return 0.5 * np.hypot.reduce(np.cross(b - a, c - a), axis=1)  # squares of areas may overflow


def _compact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices that faces use, the faces renumbered (int32), and the old rows."""
    rows, inverse = np.unique(faces, return_inverse=True)
    return vertices[rows], inverse.reshape(-1, 3).astype(np.int32), rows


def _empty() -> Patch:
    return Patch(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3)))
