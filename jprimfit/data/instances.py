"""From a solid with known surfaces to a part: which triangles are one instance, in which frame, with which areas.

An instance is a connected piece of one geometric surface: triangles that share an edge and lie on the same surface, be
it from one body or from two whose faces continue each other (as in TraceParts, where adjacent pieces with equal
parameters were merged). Pieces of one surface that do not touch are separate instances. Pieces under min_share of the
part's area, and what lies on none of the four kinds, are BACKGROUND; its area is told in Part.background_area.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jprimfit.data.areas import exact_areas
from jprimfit.data.records import BACKGROUND, Mesh, Part
from jprimfit.data.solids import Body, Solid, Surface, doubled_areas, evaluate, signed_distance, transform_surface
from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

_SAME = 1e-6  # two surfaces are one if their parameters differ by less, in the unit of a part about 2 long


def make_part(solid: Solid, *, min_share: float, name: str, **fields) -> Part | None:
    """The part of a solid in the normalised frame (centroid of the surface at the origin, longest side of the box = 2).

    Returns None where the solid is no single closed piece with a volume, or no instance is left. Instances are numbered
    by descending area. Further fields go to the Part as they are.
    """
    body = evaluate(solid)
    if not len(body.faces) or _volume(body) <= 0 or not _is_one_piece(body):
        return None
    return part_of_body(body, min_share=min_share, name=name, **fields)


def part_of_body(
    body: Body, *, min_share: float, name: str, known_areas: Float[np.ndarray, "s"] | None = None, **fields
) -> Part | None:
    """The same for a triangulation, of whatever number of pieces; None where no instance is left.

    known_areas: of the surfaces of the body, in its unit, each shared out among the triangles of its surface; without
    them they are computed from the surfaces.
    """
    corners = body.vertices[body.faces]
    if known_areas is None:
        areas = exact_areas(body)
    else:
        areas = np.sqrt(np.sum(doubled_areas(corners) ** 2, axis=1)) / 2
        flat = np.bincount(body.surface_index, weights=areas, minlength=len(body.surfaces))
        areas = areas * (known_areas / np.where(flat > 0, flat, 1.0))[body.surface_index]
    center = areas @ np.mean(corners, axis=1) / np.sum(areas)
    scale = float(np.max(np.ptp(body.vertices, axis=0))) / 2
    body = body._replace(
        vertices=(body.vertices - center[None]) / scale,
        surfaces=tuple(transform_surface(s, np.eye(3), -center / scale, 1 / scale) for s in body.surfaces),
    )
    piece = _pieces(body)
    labels, primitives, sizes = _instances(body, piece, areas / scale**2, min_share)
    if not primitives:
        return None
    mesh = Mesh(body.vertices.astype(np.float32), body.faces.astype(np.int32), labels)
    # Slivers thinner than the arcs over their edges may sum to less than nothing (areas.exact_areas).
    background = max(0.0, float(np.sum(areas[labels == BACKGROUND])) / scale**2)
    return Part(
        name=name,
        primitives=primitives,
        mesh=mesh,
        areas=sizes,
        background_area=background,
        center=center,
        scale=scale,
        **fields,
    )


def largest_residual(part: Part) -> float:
    """The largest distance of a corner of a labelled triangle from the primitive of its instance; 0 without a mesh."""
    if part.mesh is None:
        return 0.0
    worst = 0.0
    for label, primitive in enumerate(part.primitives):
        rows = np.unique(part.mesh.faces[part.mesh.labels == label])
        distance, _ = signed_distance(primitive, part.mesh.vertices[rows].astype(np.float64))
        worst = max(worst, float(np.max(np.abs(distance), initial=0.0)))
    return worst


def _volume(body: Body) -> float:
    corners = body.vertices[body.faces]
    return float(np.sum(corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])) / 6)


def _is_one_piece(body: Body) -> bool:
    ends = body.faces[:, [0, 1]].T, body.faces[:, [1, 2]].T
    first, second = np.concatenate(ends, axis=1)
    return _components(len(body.vertices), first, second)[0] == 1


def _components(count: int, first: np.ndarray, second: np.ndarray) -> tuple[int, Int[np.ndarray, "count"]]:
    graph = coo_array((np.ones(len(first), np.int8), (first, second)), shape=(count, count))
    number, member = connected_components(graph, directed=False)
    return int(number), member


def _pieces(body: Body) -> Int[np.ndarray, "f"]:
    """For every triangle the number of its connected piece of one geometric surface."""
    first, second = _neighbours(body.faces)
    one, two = body.surface_index[first], body.surface_index[second]
    pairs = np.unique(np.sort(np.stack([one, two], axis=1), axis=1), axis=0)
    same = np.eye(len(body.surfaces), dtype=bool)
    for a, b in pairs.tolist():
        same[a, b] = same[b, a] = a == b or is_same(body.surfaces[a], body.surfaces[b])
    joined = same[one, two]
    return _components(len(body.faces), first[joined], second[joined])[1]


def _neighbours(faces: Int[np.ndarray, "f 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of triangles that share an edge."""
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(ends.T)
    equal = np.all(ends[order[1:]] == ends[order[:-1]], axis=1)
    triangle = order // 3
    return triangle[:-1][equal], triangle[1:][equal]


def is_same(first: Surface, second: Surface) -> bool:
    """Whether two surfaces are geometrically one, whatever the signs of their directions and the points on their axes.

    What is no primitive counts as one surface with everything of that sort that it touches.
    """
    if first is None or second is None:
        return first is second
    if isinstance(first, Plane) and isinstance(second, Plane):
        sign = np.sign(first.normal @ second.normal)
        return _close(first.normal, sign * second.normal) and _close(first.offset, sign * second.offset)
    if isinstance(first, Sphere) and isinstance(second, Sphere):
        return _close(first.center, second.center) and _close(first.radius, second.radius)
    if isinstance(first, Cylinder) and isinstance(second, Cylinder):
        across = np.cross(second.center - first.center, first.axis)
        return (
            _close(np.cross(first.axis, second.axis), 0) and _close(across, 0) and _close(first.radius, second.radius)
        )
    if isinstance(first, Cone) and isinstance(second, Cone):
        return (
            _close(first.axis, second.axis)
            and _close(first.apex, second.apex)
            and _close(first.half_angle, second.half_angle)
        )
    return False


def _close(first, second) -> bool:
    return bool(np.all(np.abs(np.asarray(first) - second) < _SAME))


def _instances(
    body: Body, piece: Int[np.ndarray, "f"], areas: Float[np.ndarray, "f"], min_share: float
) -> tuple[Int[np.ndarray, "f"], tuple[Primitive, ...], Float[np.ndarray, "i"]]:
    """Labels of the triangles, the primitive of every instance in its gauge, and the instances' areas, descending."""
    sizes = np.bincount(piece, weights=areas)
    first = np.unique(piece, return_index=True)[1]  # a triangle of each piece
    surfaces = [body.surfaces[row] for row in body.surface_index[first].tolist()]
    known = np.array([surface is not None for surface in surfaces])
    order = np.argsort(-sizes, kind="stable")
    order = order[known[order] & (sizes[order] >= min_share * np.sum(areas))]
    label = np.full(len(sizes), BACKGROUND, np.int32)
    label[order] = np.arange(len(order))
    middle = np.mean(body.vertices[body.faces], axis=1)
    primitives = []
    for row in order.tolist():
        mine = piece == row
        primitives.append(_in_gauge(surfaces[row], areas[mine] @ middle[mine] / sizes[row]))  # type: ignore[arg-type]
    return label[piece], tuple(primitives), sizes[order]


def _in_gauge(surface: Primitive, mean: Float[np.ndarray, "3"]) -> Primitive:
    """The primitive with the signs and the point of types.py; mean is the centroid of its segment."""
    if isinstance(surface, Plane):
        sign = _sign(surface.normal)
        return Plane(sign * surface.normal + 0.0, np.float64(sign * surface.offset + 0.0))
    if isinstance(surface, Cylinder):
        center = surface.center + ((mean - surface.center) @ surface.axis) * surface.axis
        return Cylinder(_sign(surface.axis) * surface.axis + 0.0, center, np.float64(surface.radius))
    return surface


def _sign(direction: Float[np.ndarray, "3"]) -> float:
    return 1.0 if direction[np.argmax(np.abs(direction))] > 0 else -1.0
