"""Points drawn from the surface of a part: uniform by area, exactly on their primitives, with the exact normals.

A triangulation says where the surface is and which primitive every triangle stands for; its own deviation from the
curved surface is taken away by projecting each point onto the primitive. NumPy float64 on the host, without JAX: the
twins of primitives/*.project and .normal for many primitives at once, ten times faster on a few thousand points.
Letters: n points, i instances, m samples each, f triangles.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Num

from jprimfit.data import records
from jprimfit.data.records import BACKGROUND, KINDS, Cloud, Mesh, Part, Table

_TINY = np.finfo(np.float64).tiny
_AXIS_WIDTH = 1e-10  # of the distance from the center or apex: nearer than that, a point counts as on the axis


class Foot(NamedTuple):
    """Where points lie on their primitives."""

    points: Float[np.ndarray, "n 3"]  # float64, the nearest point of the primitive
    normals: Float[np.ndarray, "n 3"]  # float64, unit, the gradient of the signed distance there


def draw(part: Part, *, num_points: int, seed: int | Sequence[int], num_samples: int = 512) -> Cloud:
    """num_points points uniform by area on the surface of a part, and num_samples more on each of its instances.

    From a mesh: points on a triangle of BACKGROUND stay there and have its normal, all others lie on the primitive of
    their label within rounding and have its normal, turned to the side that the triangle faces. A part with nothing
    but a stored cloud gives a random subset of it, in random order, all of it where it has no more than num_points.

    Args:
        part: a mesh or a cloud in any frame.
        num_points: at least 1.
        seed: a part and a seed determine the cloud.
        num_samples: m of the samples (i, m, 3); 0 = none, samples and sample_normals are then None.

    Returns:
        A Cloud of float64 in the frame of the part.

    Raises:
        ValueError: the part is stored as trimmed faces only, or an instance has no area and samples were asked for.
    """
    if num_points < 1 or num_samples < 0:
        raise ValueError(f"Cannot draw {num_points} points and {num_samples} samples; ask for at least 1 and 0.")
    generator = np.random.default_rng(seed)
    if part.mesh is not None:
        return _from_mesh(generator, part, part.mesh, num_points=num_points, num_samples=num_samples)
    if part.cloud is not None:
        return _from_cloud(generator, part, part.cloud, num_points=num_points, num_samples=num_samples)
    raise ValueError(f"Part {part.name!r} has trimmed faces only, which cannot be sampled; store it with a mesh.")


def project(table: Table, labels: Int[np.ndarray, "n"], points: Num[np.ndarray, "n 3"]) -> Foot:
    """The foot of points[j] on primitive labels[j] of the table; every label must be one, there is no BACKGROUND here.

    Where no direction is distinguished (a centre, an axis) the foot is some nearest point. Points behind the apex of a
    cone go to the apex, where the normal is that of some generator.
    """
    points = np.asarray(points, np.float64)
    kind = table.kind[labels]
    feet, normals = np.empty(points.shape), np.empty(points.shape)
    for number, name in enumerate(KINDS):
        rows = np.flatnonzero(kind == number)
        if rows.size:
            parameters = table.parameters.take(labels[rows], axis=0)
            feet[rows], normals[rows] = _PROJECTIONS[name](points.take(rows, axis=0), parameters)
    return Foot(feet, normals)


def _plane(points: np.ndarray, parameters: np.ndarray) -> Foot:
    normal = parameters[:, :3]
    return Foot(points - (_dot(points, normal) - parameters[:, 3])[:, None] * normal, normal)


def _sphere(points: np.ndarray, parameters: np.ndarray) -> Foot:
    center, radius = parameters[:, :3], parameters[:, 3]
    outwards = _unit(points - center)
    return Foot(center + radius[:, None] * outwards, outwards)


def _cylinder(points: np.ndarray, parameters: np.ndarray) -> Foot:
    axis, center, radius = parameters[:, :3], parameters[:, 3:6], parameters[:, 6]
    height, outwards, _ = _about_axis(points - center, axis)
    return Foot(center + height[:, None] * axis + radius[:, None] * outwards, outwards)


def _cone(points: np.ndarray, parameters: np.ndarray) -> Foot:
    axis, apex = parameters[:, :3], parameters[:, 3:6]
    cosine, sine = np.cos(parameters[:, 6])[:, None], np.sin(parameters[:, 6])[:, None]
    height, outwards, radius = _about_axis(points - apex, axis)
    along = np.maximum(height[:, None] * cosine + radius[:, None] * sine, 0.0)
    return Foot(apex + along * (cosine * axis + sine * outwards), cosine * outwards - sine * axis)


_PROJECTIONS: dict[str, Callable[[np.ndarray, np.ndarray], Foot]] = {
    "plane": _plane,
    "sphere": _sphere,
    "cylinder": _cylinder,
    "cone": _cone,
}


def _about_axis(offset: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height along the axis, unit vector away from it, distance from it."""
    height = _dot(offset, axis)
    radial = offset - height[:, None] * axis
    sq_radius = _dot(radial, radial)
    # On the axis any direction across it will do, and near it the radial offset is rounding, which need not stand
    # across it: then the coordinate axis that is least along it, made perpendicular.
    lost = np.flatnonzero(sq_radius <= _AXIS_WIDTH**2 * (_dot(offset, offset) + _TINY))
    if lost.size:
        across = np.eye(3)[np.argmin(np.abs(axis[lost]), axis=1)]
        radial[lost] = across - _dot(across, axis[lost])[:, None] * axis[lost]
    return height, _unit(radial), np.sqrt(sq_radius)


class _Faces(NamedTuple):
    """Triangles of a mesh in the order of their labels."""

    corner: np.ndarray  # (f, 3), the first corner
    edges: np.ndarray  # (f, 2, 3), from it to the others
    normals: np.ndarray  # (f, 3), unit, the side they face; 0 where the area is
    labels: np.ndarray  # (f,)
    area_before: np.ndarray  # (f + 1,), of all triangles before this one


def _from_mesh(generator: np.random.Generator, part: Part, mesh: Mesh, *, num_points: int, num_samples: int) -> Cloud:
    faces = _faces(mesh)
    table = records.pack(part.primitives)
    total = faces.area_before[-1]
    if not total > 0.0:
        raise ValueError(f"Part {part.name!r} has a mesh without area; store it with triangles that have some.")
    points, normals, labels = _on_triangles(generator, faces, table, total * generator.random(num_points))
    cloud = Cloud(points, normals, labels)
    if num_samples == 0:
        return cloud
    count = len(part.primitives)
    bounds = faces.area_before[np.searchsorted(faces.labels, np.arange(count + 1))]
    own = np.diff(bounds)
    if not np.all(own > 0.0):
        raise ValueError(f"Part {part.name!r} has no triangle on instance {int(np.argmin(own))}; leave it out.")
    place = bounds[:-1, None] + own[:, None] * generator.random((count, num_samples))
    # Rounding may carry a place over the border to the next instance.
    place = np.clip(place, bounds[:-1, None], np.nextafter(bounds[1:, None], 0.0))
    samples, sample_normals, _ = _on_triangles(generator, faces, table, place.ravel())
    shape = (count, num_samples, 3)
    return cloud._replace(samples=samples.reshape(shape), sample_normals=sample_normals.reshape(shape))


def _faces(mesh: Mesh) -> _Faces:
    order = np.argsort(mesh.labels, kind="stable")
    corners = mesh.vertices.astype(np.float64)[mesh.faces[order]]
    edges = corners[:, 1:] - corners[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    double_area = np.sqrt(_dot(normals, normals))
    normals /= np.where(double_area > 0.0, double_area, 1.0)[:, None]
    area_before = np.concatenate([[0.0], np.cumsum(double_area / 2.0)])
    return _Faces(corners[:, 0], edges, normals, mesh.labels[order], area_before)


def _on_triangles(
    generator: np.random.Generator, faces: _Faces, table: Table, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and labels; place says, as the area before it, on which triangle each point lies."""
    face = np.clip(np.searchsorted(faces.area_before, place, side="right") - 1, 0, len(faces.labels) - 1)
    weights = generator.random((len(place), 2))
    # Uniform in the parallelogram of the two edges; its far half is folded back.
    weights = np.where(weights.sum(axis=1, keepdims=True) > 1.0, 1.0 - weights, weights)
    points = faces.corner.take(face, axis=0) + np.einsum("nk,nkc->nc", weights, faces.edges.take(face, axis=0))
    normals, labels = faces.normals.take(face, axis=0), faces.labels.take(face).astype(np.int32)
    rows = np.flatnonzero(labels != BACKGROUND)
    foot = project(table, labels[rows], points[rows])
    points[rows] = foot.points
    turned = np.where(_dot(foot.normals, normals[rows]) < 0.0, -1.0, 1.0)
    normals[rows] = turned[:, None] * foot.normals
    return points, normals, labels


def _from_cloud(
    generator: np.random.Generator, part: Part, cloud: Cloud, *, num_points: int, num_samples: int
) -> Cloud:
    rows = generator.permutation(len(cloud.points))[:num_points]
    samples, sample_normals = None, None
    if num_samples:
        samples, sample_normals = _stored_samples(generator, part, cloud, num_samples=num_samples)
    return Cloud(
        cloud.points[rows].astype(np.float64),
        cloud.normals[rows].astype(np.float64),
        cloud.labels[rows].astype(np.int32),
        None if cloud.noisy_points is None else cloud.noisy_points[rows].astype(np.float64),
        samples,
        sample_normals,
    )


def _stored_samples(
    generator: np.random.Generator, part: Part, cloud: Cloud, *, num_samples: int
) -> tuple[np.ndarray, np.ndarray | None]:
    """num_samples of the stored samples of each instance, or of its points where none are stored."""
    count = len(part.primitives)
    if cloud.samples is not None:
        rows = _choose(generator, cloud.samples.shape[1], num_samples=num_samples)
        normals = None if cloud.sample_normals is None else cloud.sample_normals[:, rows].astype(np.float64)
        return cloud.samples[:, rows].astype(np.float64), normals
    chosen = np.empty((count, num_samples), np.int64)
    for instance in range(count):
        rows = np.flatnonzero(cloud.labels == instance)
        if rows.size == 0:
            raise ValueError(f"Part {part.name!r} has no point on instance {instance}; leave it out.")
        chosen[instance] = rows[_choose(generator, len(rows), num_samples=num_samples)]
    return cloud.points[chosen].astype(np.float64), cloud.normals[chosen].astype(np.float64)


def _choose(generator: np.random.Generator, count: int, *, num_samples: int) -> np.ndarray:
    """num_samples rows of count, none twice unless it must be."""
    return np.concatenate([generator.permutation(count) for _ in range(-(-num_samples // count))])[:num_samples]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nc,nc->n", a, b)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors of length 1; the zero vector becomes the first of the frame."""
    sq_length = _dot(vectors, vectors)
    unit = vectors / np.sqrt(np.where(sq_length > 0.0, sq_length, 1.0))[:, None]
    unit[sq_length <= 0.0] = [1.0, 0.0, 0.0]
    return unit
