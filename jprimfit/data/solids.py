"""Solids whose every triangle knows the surface it came from: the only file that uses manifold3d.

A solid under construction is a tree of plain values: bodies (closed triangulations whose faces name exact surfaces)
joined by union, difference and intersection. Moving it moves the surfaces along. `evaluate` computes the booleans; the
library passes the number of the input surface through to every triangle of the result (original ids of triangle runs).
A surface is a primitive of ours, or None for what is none of the four kinds.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

Surface = Primitive | None
_SETTLE_STEPS = 6
_SLIVER = 1e-5  # triangles of less area (in squared extents of the body) may be turned over: nobody will see them
_SETTLE_LIMIT = 0.05  # a vertex that would travel farther than this part of the body's extent stays where it is


class Body(NamedTuple):
    """A closed triangulation, counter-clockwise from outside; the corners of a face lie on the surface it names."""

    vertices: Float[np.ndarray, "v 3"]  # float64
    faces: Int[np.ndarray, "f 3"]  # rows of vertices
    surface_index: Int[np.ndarray, "f"]  # row of surfaces
    surfaces: tuple[Surface, ...]


class Combination(NamedTuple):
    """A boolean of solids; "difference" takes all others away from the first."""

    operation: str  # "union", "difference" or "intersection"
    solids: tuple["Solid", ...]


Solid = Body | Combination


def union(*solids: Solid) -> Solid:
    """What lies in at least one of the solids."""
    return Combination("union", solids)


def difference(solid: Solid, *others: Solid) -> Solid:
    """What lies in solid and in none of the others."""
    return Combination("difference", (solid, *others)) if others else solid


def intersection(*solids: Solid) -> Solid:
    """What lies in all solids."""
    return Combination("intersection", solids)


def transform(solid: Solid, rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> Solid:
    """The solid after x -> R x + t, its surfaces with it; copies of one solid at several places stay distinct."""
    if isinstance(solid, Combination):
        return Combination(solid.operation, tuple(transform(s, rotation, translation) for s in solid.solids))
    surfaces = tuple(transform_surface(surface, rotation, translation, 1.0) for surface in solid.surfaces)
    return solid._replace(vertices=solid.vertices @ rotation.T + translation[None], surfaces=surfaces)


def transform_surface(
    surface: Surface, rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"], scale: float
) -> Surface:
    """The surface after x -> scale R x + t; signs of directions are turned along, not brought into their gauge."""

    def place(point: np.ndarray) -> np.ndarray:
        return scale * (rotation @ point) + translation

    match surface:
        case Plane(normal, offset):
            turned = rotation @ normal
            return Plane(turned, np.float64(scale * offset + turned @ translation))
        case Sphere(center, radius):
            return Sphere(place(center), np.float64(scale * radius))
        case Cylinder(axis, center, radius):
            return Cylinder(rotation @ axis, place(center), np.float64(scale * radius))
        case Cone(axis, apex, half_angle):
            return Cone(rotation @ axis, place(apex), np.float64(half_angle))
    return None


def triangulate(outline: Float[np.ndarray, "k 2"]) -> Int[np.ndarray, "f 3"]:
    """Triangles (rows of outline) that fill a simple counter-clockwise polygon."""
    import manifold3d

    return np.asarray(manifold3d.triangulate([np.ascontiguousarray(outline, np.float64)]), np.int64).reshape(-1, 3)


def evaluate(solid: Solid) -> Body:
    """The booleans done: one body whose surface_index names, for every triangle, the surface it was cut from.

    The corners of cut edges, first found on the chords of the triangulation, are moved onto the exact surfaces that
    meet there. A result without any volume has no faces. ValueError where a body is no closed surface.
    """
    surfaces: dict[int, Surface] = {}
    mesh = _manifold(solid, surfaces).to_mesh64()
    vertices = np.array(mesh.vert_properties[:, :3], np.float64)
    faces = np.array(mesh.tri_verts, np.int64).reshape(-1, 3)
    twin = np.arange(len(vertices))
    twin[np.asarray(mesh.merge_from_vert, np.int64)] = np.asarray(mesh.merge_to_vert, np.int64)
    used, faces = np.unique(twin[faces], return_inverse=True)
    sizes = np.diff(np.asarray(mesh.run_index, np.int64)) // 3
    names = np.repeat(np.asarray(mesh.run_original_id, np.int64), sizes[: len(mesh.run_original_id)])
    kept, surface_index = np.unique(names, return_inverse=True)
    body = Body(vertices[used], faces.reshape(-1, 3), surface_index, tuple(surfaces[int(name)] for name in kept))
    return _settled(body) if len(body.faces) else body


def _manifold(solid: Solid, surfaces: dict[int, Surface]):
    """The library's object of a solid; surfaces receives the surface of every number that its triangles may bear."""
    import manifold3d

    if isinstance(solid, Combination):
        operation = {"union": "Add", "difference": "Subtract", "intersection": "Intersect"}[solid.operation]
        parts = [_manifold(part, surfaces) for part in solid.solids]
        return manifold3d.Manifold.batch_boolean(parts, getattr(manifold3d.OpType, operation))
    first = manifold3d.Manifold.reserve_ids(len(solid.surfaces))
    surfaces.update(zip(range(first, first + len(solid.surfaces)), solid.surfaces, strict=True))
    order = np.argsort(solid.surface_index, kind="stable")
    counts = np.bincount(solid.surface_index, minlength=len(solid.surfaces))
    made = manifold3d.Manifold(
        manifold3d.Mesh64(
            vert_properties=np.ascontiguousarray(solid.vertices, np.float64),
            tri_verts=np.ascontiguousarray(solid.faces[order], np.uint64),
            run_index=np.append(0, 3 * np.cumsum(counts)).astype(np.uint64),
            run_original_id=np.arange(first, first + len(counts), dtype=np.uint32),
        )
    )
    if made.status() != manifold3d.Error.NoError:
        raise ValueError(f"A body of {len(solid.faces)} triangles is not closed ({made.status()}); correct its faces.")
    return made


def signed_distance(surface: Primitive, points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances (n,) of points to a surface in float64, and their gradients (n, 3); 0 where undefined."""
    if isinstance(surface, Plane):
        return points @ surface.normal - surface.offset, np.broadcast_to(surface.normal, points.shape)
    offset = points - (surface.apex if isinstance(surface, Cone) else surface.center)[None]
    if isinstance(surface, Sphere):
        length, radial = _length_and_direction(offset)
        return length - surface.radius, radial
    along = offset @ surface.axis
    length, radial = _length_and_direction(offset - along[:, None] * surface.axis[None])
    if isinstance(surface, Cylinder):
        return length - surface.radius, radial
    cosine, sine = np.cos(surface.half_angle), np.sin(surface.half_angle)
    return cosine * length - sine * along, cosine * radial - sine * surface.axis[None]


def _length_and_direction(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = np.sqrt(np.sum(vectors * vectors, axis=1))
    return length, vectors / np.where(length > 0, length, 1.0)[:, None]


def _settled(body: Body) -> Body:
    """The body with every vertex on all surfaces that meet there; one that would run away stays."""
    pairs = np.unique(np.stack([body.faces.ravel(), np.repeat(body.surface_index, 3)], axis=1), axis=0)
    moved = onto_surfaces(body.vertices, pairs, body.surfaces)
    extent = float(np.max(np.ptp(body.vertices, axis=0)))
    far = np.sum((moved - body.vertices) ** 2, axis=1) > (_SETTLE_LIMIT * extent) ** 2
    moved[far | np.any(~np.isfinite(moved), axis=1)] = body.vertices[far | np.any(~np.isfinite(moved), axis=1)]
    return body._replace(vertices=_without_flips(body, moved))


def onto_surfaces(
    points: Float[np.ndarray, "n 3"], pairs: Int[np.ndarray, "p 2"], surfaces: Sequence[Surface]
) -> Float[np.ndarray, "n 3"]:
    """The points moved onto all their surfaces by Newton steps of least length on the distances.

    pairs are rows (point, surface), sorted; surfaces that are None ask for nothing. Surfaces that touch tangentially do
    not determine a point: it may run away, and it is for the caller to say how far it may.
    """
    known = np.array([surface is not None for surface in surfaces])
    pairs = pairs[known[pairs[:, 1]]]
    residual = np.zeros(len(pairs))
    gradient = np.zeros((len(pairs), 3))
    moved = points.copy()
    extent = float(np.max(np.ptp(points, axis=0)))
    slot = np.arange(len(pairs)) - np.searchsorted(pairs[:, 0], pairs[:, 0])  # place of a surface among its point's
    depth = int(slot.max(initial=0)) + 1
    for _ in range(_SETTLE_STEPS):
        for index in np.unique(pairs[:, 1]):
            rows = np.flatnonzero(pairs[:, 1] == index)
            residual[rows], gradient[rows] = signed_distance(surfaces[index], moved[pairs[rows, 0]])  # type: ignore
        open_rows = np.unique(pairs[np.abs(residual) > 1e-9 * extent, 0])
        if not len(open_rows):
            break
        place = np.full(len(moved), -1)
        place[open_rows] = np.arange(len(open_rows))
        rows = np.flatnonzero(place[pairs[:, 0]] >= 0)
        system, right = np.zeros((len(open_rows), depth, 3)), np.zeros((len(open_rows), depth, 1))
        system[place[pairs[rows, 0]], slot[rows]] = gradient[rows]
        right[place[pairs[rows, 0]], slot[rows], 0] = residual[rows]
        moved[open_rows] -= (np.linalg.pinv(system, rcond=0.05) @ right)[:, :, 0]
    return moved


def _without_flips(body: Body, moved: np.ndarray) -> np.ndarray:
    """The moved vertices, but the old ones at corners of triangles that the move would turn over visibly."""
    before = doubled_areas(body.vertices[body.faces])
    visible = (_SLIVER * np.max(np.ptp(body.vertices, axis=0)) ** 2) ** 2
    while True:  # what goes back may turn over its neighbours; in the end all is as it was
        after = doubled_areas(moved[body.faces])
        flipped = (np.sum(before * after, axis=1) < 0) & (np.sum(after * after, axis=1) > visible)
        stay = np.unique(body.faces[flipped])
        if np.array_equal(moved[stay], body.vertices[stay]):
            return moved
        moved[stay] = body.vertices[stay]


def doubled_areas(corners: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f 3"]:
    """The outward normal of every triangle, twice as long as its area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
