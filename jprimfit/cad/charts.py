"""Triangulated pieces of primitives: the surface of each kind around given points, as a mesh of a wanted pitch.

Host code in float64 NumPy. A chart is (nearly) isometric, so that cells have one size everywhere: a plane's two
in-plane coordinates; a cylinder's (arc, height); a cone's (arc, slant), with its apex as one vertex; a sphere's
subdivided icosahedron. Charts that go all the way round are closed: no seam. "Feet" are points of the surface itself.
Letters: n points, v vertices, f faces.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.spatial import KDTree

from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

STEPS_PER_TURN = 64  # a turn of 64 chords loses 0.04 % of the area and looks round
POLAR_RATIO = 3.0  # a cone is meshed all the way round where its radius is below this many widths of the border


class Mesh(NamedTuple):
    """A triangulated surface; faces turn counter-clockwise seen from where the primitive's normal points to."""

    vertices: Float64[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]  # int32, rows of vertices


class Interval(NamedTuple):
    """Angles start .. start + width, or a whole turn."""

    start: float
    width: float  # 2 pi where full
    full: bool


def frame(axis: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Right-handed orthonormal rows: two directions perpendicular to the axis, and the axis itself.

    The first is the coordinate direction most perpendicular to the axis, made perpendicular: meshes of parts that
    stand along the coordinate axes lie along them too.
    """
    unit = np.asarray(axis, np.float64)
    unit = unit / np.sqrt(unit @ unit)
    first = np.eye(3)[np.argmin(np.abs(unit))]
    first = first - (first @ unit) * unit
    first = first / np.sqrt(first @ first)
    return np.stack([first, np.cross(unit, first), unit])


def angular_interval(angles: Float[np.ndarray, "n"], *, gap: float) -> Interval:
    """The shortest interval that holds all angles; a whole turn where no gap between neighbours exceeds `gap`."""
    ordered = np.sort(np.mod(angles, 2 * np.pi))
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    if gaps[widest] <= gap:
        return Interval(0.0, 2 * np.pi, True)
    return Interval(float(ordered[(widest + 1) % len(ordered)]), float(2 * np.pi - gaps[widest]), False)


def feet(primitive: Primitive, points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """The nearest point of the unbounded surface to each point, to rounding; any nearest point where several are."""
    points = np.asarray(points, np.float64)
    if isinstance(primitive, Plane):
        normal = np.asarray(primitive.normal, np.float64)
        square = normal @ normal
        # Twice: the first step leaves the rounding of large coordinates, the second removes it.
        for _ in range(2):
            points = points - ((points @ normal - float(primitive.offset)) / square)[:, None] * normal[None, :]
        return points
    if isinstance(primitive, Sphere):
        center = np.asarray(primitive.center, np.float64)[None, :]
        return center + float(primitive.radius) * normals(primitive, points)
    axis, radial, height, distance = _axial(primitive, points)
    if isinstance(primitive, Cylinder):
        center = np.asarray(primitive.center, np.float64)[None, :]
        return center + height[:, None] * axis[None, :] + float(primitive.radius) * radial
    sine, cosine = np.sin(float(primitive.half_angle)), np.cos(float(primitive.half_angle))
    slant = np.maximum(height * cosine + distance * sine, 0.0)[:, None]
    return np.asarray(primitive.apex, np.float64)[None, :] + slant * (cosine * axis[None, :] + sine * radial)


def normals(primitive: Primitive, points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Unit normals of the surface at the feet of the points: a plane's own, elsewhere away from centre or axis."""
    points = np.asarray(points, np.float64)
    if isinstance(primitive, Plane):
        return np.broadcast_to(frame(np.asarray(primitive.normal))[2], points.shape).copy()
    if isinstance(primitive, Sphere):
        offset = points - np.asarray(primitive.center, np.float64)[None, :]
        length = np.sqrt(np.sum(offset**2, axis=1))
        offset[length == 0.0] = np.array([0.0, 0.0, 1.0])
        return offset / np.where(length == 0.0, 1.0, length)[:, None]
    axis, radial, _, distance = _axial(primitive, points)
    if isinstance(primitive, Cylinder):
        return radial
    sine, cosine = np.sin(float(primitive.half_angle)), np.cos(float(primitive.half_angle))
    outward = cosine * radial - sine * axis[None, :]
    outward[distance == 0.0] = -axis  # the apex has no normal; seen from its tip the cone faces against its axis
    return outward


def signed_distances(primitive: Primitive, points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n"]:
    """Length from the surface to each point, positive where `normals` point: outside, for a plane on its normal's side.

    Whether the material is inside or outside plays no part. Points behind a cone's apex are outside.
    """
    points = np.asarray(points, np.float64)
    foot = feet(primitive, points)
    offset = points - foot
    along = np.sum(offset * normals(primitive, points), axis=1)
    if isinstance(primitive, Cone):
        behind = np.all(foot == np.asarray(primitive.apex, np.float64)[None, :], axis=1)
        along[behind] = np.sqrt(np.sum(offset[behind] ** 2, axis=1))
    return along


def edges(faces: Int[np.ndarray, "f 3"]) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, "f 3"]]:
    """The undirected edges of triangles, and which of them each face's edges 01, 12, 20 are."""
    pairs = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).astype(np.int64)
    low, high = pairs.min(axis=2), pairs.max(axis=2)
    stride = int(faces.max(initial=0)) + 1
    key, inverse = np.unique((low * stride + high).ravel(), return_inverse=True)
    return np.stack([key // stride, key % stride], axis=1), inverse.reshape(-1, 3)


def mesh(
    primitive: Primitive, points: Float64[np.ndarray, "n 3"], *, pitch: float, border: float, max_vertices: int
) -> Mesh | None:
    """The part of the surface that reaches at least `border` beyond the feet of n >= 1 points.

    Args:
        primitive: the surface.
        points: feet, on the surface.
        pitch: wanted length of edges; shorter where the surface curves within it.
        border: length along the surface.
        max_vertices: None is returned, and nothing large allocated, where more would be needed.
    """
    if isinstance(primitive, Sphere):
        return _sphere(primitive, points, pitch=pitch, border=border, max_vertices=max_vertices)
    if isinstance(primitive, Plane):
        axes = frame(np.asarray(primitive.normal))
        origin = points.mean(axis=0)
        flat = _times(points - origin[None, :], axes[:2].T)
        low, high = flat.min(axis=0) - border, flat.max(axis=0) + border
        grid = _grid(high - low, pitch, max_vertices)
        if grid is None:
            return None
        position = low[None, :] + grid.parameters * (high - low)[None, :]
        return Mesh(feet(primitive, origin[None, :] + _times(position, axes[:2])), grid.faces)
    return _round(primitive, points, pitch=pitch, border=border, max_vertices=max_vertices)


class _Grid(NamedTuple):
    """A rectangle [0, 1]^2 in triangles."""

    parameters: Float64[np.ndarray, "v 2"]
    faces: Int[np.ndarray, "f 3"]


def _grid(
    size: Float64[np.ndarray, "2"], pitch: float, max_vertices: int, *, min_steps: int = 1, closed: bool = False
) -> _Grid | None:
    """Rectangle of the given side lengths; `closed` joins the first coordinate's ends, min_steps is that one's."""
    steps = np.maximum(np.ceil(size / pitch), np.array([max(min_steps, 3 if closed else 1), 1]))
    if not np.all(np.isfinite(steps)) or np.prod(steps + 1) > max_vertices:
        return None
    across, along = int(steps[0]), int(steps[1])
    columns = across if closed else across + 1
    index = np.arange(columns * (along + 1), dtype=np.int32).reshape(along + 1, columns)
    after = np.roll(index, -1, axis=1)
    if not closed:
        index, after = index[:, :-1], after[:, :-1]
    corner = [part.ravel() for part in (index[:-1], after[:-1], after[1:], index[1:])]
    faces = np.concatenate([np.stack(corner[:3], axis=1), np.stack([corner[0], *corner[2:]], axis=1)])
    u, v = np.meshgrid(np.arange(columns) / across, np.arange(along + 1) / along)
    return _Grid(np.stack([u.ravel(), v.ravel()], axis=1), faces)


def _round(
    primitive: Cylinder | Cone, points: Float64[np.ndarray, "n 3"], *, pitch: float, border: float, max_vertices: int
) -> Mesh | None:
    """Cylinders and cones: an angle by a length along the straight lines of the surface."""
    is_cone = isinstance(primitive, Cone)
    origin = np.asarray(primitive.apex if is_cone else primitive.center, np.float64)
    sine, cosine = (np.sin(float(primitive.half_angle)), np.cos(float(primitive.half_angle))) if is_cone else (0.0, 1.0)
    axes = frame(np.asarray(primitive.axis))
    local = _times(points - origin[None, :], axes.T)
    along = local[:, 2] / cosine if is_cone else local[:, 2]
    low, high = along.min() - border, along.max() + border
    if is_cone:
        low = max(low, 0.0)
    smallest, largest = (low * sine, high * sine) if is_cone else (float(primitive.radius),) * 2
    angles = np.arctan2(local[:, 1], local[:, 0])
    interval = angular_interval(angles, gap=2 * border / largest)
    pad = border / smallest if smallest > POLAR_RATIO * border or not is_cone else np.pi
    if interval.full or interval.width + 2 * pad >= 2 * np.pi:
        interval, pad = Interval(0.0, 2 * np.pi, True), 0.0
    width = interval.width + 2 * pad
    size = np.array([width * largest, high - low])
    min_steps = int(np.ceil(STEPS_PER_TURN * width / (2 * np.pi)))
    grid = _grid(size, pitch, max_vertices, min_steps=min_steps, closed=interval.full)
    if grid is None:
        return None
    angle = interval.start - pad + grid.parameters[:, 0] * width
    length = low + grid.parameters[:, 1] * (high - low)
    radius = length * sine if is_cone else np.full(len(length), largest)
    position = np.stack([radius * np.cos(angle), radius * np.sin(angle), length * cosine], axis=1)
    faces = grid.faces
    if is_cone and low == 0.0:
        # All vertices of the first row are the apex: one of them stands for all.
        faces = np.where(length[faces] == 0.0, 0, faces).astype(np.int32)
        faces = faces[(length[faces] == 0.0).sum(axis=1) < 2]
    return Mesh(origin[None, :] + _times(position, axes), faces)


def _sphere(
    primitive: Sphere, points: Float64[np.ndarray, "n 3"], *, pitch: float, border: float, max_vertices: int
) -> Mesh | None:
    """An icosahedron, refined only near the points: a small cap of a huge sphere costs no more than a small sphere."""
    center, radius = np.asarray(primitive.center, np.float64), float(primitive.radius)
    tree = KDTree((points - center[None, :]) / radius)
    vertices, faces = _icosahedron()
    edge, goal = 1.0515, min(pitch / radius, 2 * np.pi / STEPS_PER_TURN * 1.25)
    # The first split is by 1 .. 7, the others by 2, so that edges come within a quarter of the wanted length.
    doublings = max(int(np.floor(np.log2(edge / goal))) - 2, 0)
    factors = [max(int(np.ceil(edge / goal / 2.0**doublings)), 1)] + [2] * doublings
    for factor in factors:
        # 1.3: faces of the icosahedron swell by up to that much when they are pushed out to the sphere.
        reach = border / radius + 1.3 * edge
        middle = vertices[faces].mean(axis=1)
        middle = middle / np.sqrt(np.sum(middle**2, axis=1, keepdims=True))
        faces = faces[tree.query(middle, distance_upper_bound=reach)[0] < reach]
        if len(faces) * factor**2 > 2 * max_vertices:
            return None
        vertices, faces = _halved(vertices, faces) if factor == 2 else _split(vertices, faces, factor)
        edge = edge / factor
    return Mesh(center[None, :] + radius * vertices, faces.astype(np.int32))


def _icosahedron() -> tuple[np.ndarray, np.ndarray]:
    """Twelve vertices on the unit sphere, twenty faces seen counter-clockwise from outside."""
    golden = (1 + np.sqrt(5)) / 2
    base = np.array([[0.0, s, t * golden] for s in (-1, 1) for t in (-1, 1)])
    vertices = np.concatenate([np.roll(base, shift, axis=1) for shift in range(3)]) / np.sqrt(1 + golden**2)
    triples = np.array([(i, j, k) for i in range(12) for j in range(i) for k in range(j)])
    corner = vertices[triples]
    sides = np.sqrt(np.sum((corner - np.roll(corner, 1, axis=1)) ** 2, axis=2))
    triples = triples[np.all(sides < 1.1, axis=1)]
    a, b, c = np.moveaxis(vertices[triples], 1, 0)
    inward = np.sum(np.cross(b - a, c - a) * a, axis=1) < 0
    triples[inward] = triples[inward][:, ::-1]
    return vertices, triples


def _split(vertices: np.ndarray, faces: np.ndarray, factor: int) -> tuple[np.ndarray, np.ndarray]:
    """Every face in factor^2 faces, vertices pushed out to the unit sphere; for few faces."""
    index = {}
    for i in range(factor + 1):
        for j in range(factor + 1 - i):
            index[i, j] = len(index)
    weights = np.array([(factor - i - j, i, j) for i, j in index]) / factor
    small = [(index[i, j], index[i + 1, j], index[i, j + 1]) for i, j in index if i + j < factor]
    small += [(index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]) for i, j in index if i + j < factor - 1]
    points = np.einsum("pc,fcx->fpx", weights, vertices[faces]).reshape(-1, 3)
    points = points / np.sqrt(np.sum(points**2, axis=1, keepdims=True))
    offset = np.arange(len(faces)) * len(index)
    # Copies of a vertex on a shared edge differ by rounding only: they become one.
    first = KDTree(points).query(points, k=len(faces) and min(8, len(points)), distance_upper_bound=1e-6)[1].min(axis=1)
    kept, inverse = np.unique(first, return_inverse=True)
    return points[kept], inverse[(offset[:, None, None] + np.array(small)[None]).reshape(-1, 3)]


def _halved(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every face in four by the midpoints of its edges, pushed out to the unit sphere."""
    pairs, of_face = edges(faces)
    middle = vertices[pairs].sum(axis=1)
    middle = middle / np.sqrt(np.sum(middle**2, axis=1, keepdims=True))
    ab, bc, ca = (of_face + len(vertices)).T
    a, b, c = faces.T
    quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([vertices, middle]), np.concatenate([np.stack(part, axis=1) for part in quarters])


def _axial(
    primitive: Cylinder | Cone, points: Float64[np.ndarray, "n 3"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Axis, unit radial direction, height along the axis from centre or apex, and distance from the axis."""
    origin = primitive.apex if isinstance(primitive, Cone) else primitive.center
    axes = frame(np.asarray(primitive.axis))
    local = _times(points - np.asarray(origin, np.float64)[None, :], axes.T)
    distance = np.hypot(local[:, 0], local[:, 1])
    on_axis: Bool[np.ndarray, "n"] = distance == 0.0
    plane = np.where(on_axis[:, None], np.array([[1.0, 0.0]]), local[:, :2])
    radial = _times(plane / np.where(on_axis, 1.0, distance)[:, None], axes[:2])
    return axes[2], radial, local[:, 2], distance


def _times(rows: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """The product; for three columns on a busy machine four times faster than BLAS, whose threads wait."""
    return np.einsum("nc,cd->nd", rows, matrix)
