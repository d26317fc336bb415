"""What a scanner sees of a part: thinner clouds away from it, one side only, and stray points.

Pure functions of NumPy arrays; whoever calls them draws the settings of a scan. Points are thinned by rejection, and
what is hidden is decided ray by ray on the triangles of the part, so that neither depends on how dense the cloud is.
Letters: n points, v viewpoints, t triangles. Lengths in the frame of the part.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from jprimfit.data import surfaces
from jprimfit.data.records import BACKGROUND, Cloud, Mesh, Part

OVERSAMPLED = 2  # candidates of a round, in points that are wanted
MAX_ROUNDS = 16
ENLARGED = 1.2  # side of the box of stray points, in sides of the cloud's
NEAREST, FARTHEST = 1.5, 4.0  # distance of a viewpoint from the middle, in half diagonals: outside every part
_CELLS = 48  # along each side of the grid in which triangles meet the points behind them
_MARGIN = 1e-3  # of the half diagonal: corners of triangles are that far from the surface, and walls are thicker
_DRAW, _KEEP = 0, 1  # streams of random numbers of one scan


class Falloff(NamedTuple):
    """A density that falls log-linearly across the part."""

    direction: Float[np.ndarray, "3"]  # unit, towards the thin end
    ratio: float  # of the densities at the two ends, at least 1


def scan(
    part: Part,
    *,
    num_points: int,
    seed: Sequence[int],
    num_samples: int = 0,
    falloff: Falloff | None = None,
    viewpoints: Float[np.ndarray, "v 3"] | None = None,
) -> Cloud:
    """At most num_points points as surfaces.draw gives them, thinned and seen; labels stay those of the part.

    There are fewer where 32 times as many candidates do not suffice, or where the part is a stored cloud. Samples are
    of whole instances. ValueError where nothing is left, and for viewpoints on a part without a mesh.
    """
    if viewpoints is not None and part.mesh is None:
        raise ValueError(f"Part {part.name!r} has no mesh to tell what hides what; set partial_share to 0.")
    generator = np.random.default_rng([*seed, _KEEP])
    rounds, found, samples = [], 0, (None, None)
    for number in range(MAX_ROUNDS if part.mesh is not None else 1):
        cloud = surfaces.draw(
            part,
            num_points=OVERSAMPLED * num_points,
            seed=[*seed, _DRAW, number],
            num_samples=0 if number else num_samples,
        )
        samples = samples if number else cloud[4:]
        kept = np.arange(len(cloud.points))
        if falloff is not None:
            kept = kept[generator.random(len(kept)) < density(cloud.points, falloff, extent=_corners(part))]
        if viewpoints is not None and part.mesh is not None:
            kept = kept[visible(cloud.points[kept], cloud.normals[kept], part.mesh, viewpoints)]
        rounds.append([None if field is None else field[kept] for field in cloud[:4]])
        found += len(kept)
        if found >= num_points:
            break
    if found == 0:
        raise ValueError(f"Nothing of part {part.name!r} is seen; its triangles must face outwards.")
    fields: Any = [
        None if pieces[0] is None else np.concatenate(pieces)[:num_points] for pieces in zip(*rounds, strict=True)
    ]
    return Cloud._make([*fields, *samples])


def density(
    points: Num[np.ndarray, "n 3"], falloff: Falloff, *, extent: Num[np.ndarray, "v 3"]
) -> Float[np.ndarray, "n"]:
    """The density at each point: 1 at one end of the extent, 1 / ratio at the other, log-linear between them."""
    ends = extent @ falloff.direction
    length = float(np.ptp(ends))
    place = np.clip((points @ falloff.direction - ends.min()) / (length if length > 0.0 else 1.0), 0.0, 1.0)
    return falloff.ratio**-place


def around(generator: np.random.Generator, part: Part, *, num: int) -> Float[np.ndarray, "v 3"]:
    """Viewpoints in random directions from the middle of the part's box, 1.5 to 4 half diagonals from it."""
    corners = _corners(part)
    low, high = corners.min(axis=0), corners.max(axis=0)
    directions = random_unit(generator, num)
    distance = generator.uniform(NEAREST, FARTHEST, num) * _length(high - low) / 2.0
    return (low + high)[None] / 2.0 + distance[:, None] * directions


def visible(
    points: Num[np.ndarray, "n 3"],
    normals: Num[np.ndarray, "n 3"],
    mesh: Mesh,
    viewpoints: Num[np.ndarray, "v 3"],
) -> Bool[np.ndarray, "n"]:
    """Whether each point is seen from any of the viewpoints.

    Args:
        points: on the surface of the mesh, or beside it by what the triangles cut off.
        normals: unit, outwards.
        mesh: closed, its triangles facing outwards.
        viewpoints: outside a sphere around the mesh.
    """
    seen = np.zeros(len(points), bool)
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle, margin = (low + high) / 2.0, _MARGIN * _length(high - low) / 2.0
    for viewpoint in viewpoints:
        rows = np.flatnonzero(~seen & (_dot(points - viewpoint[None], normals) < 0.0))
        seen[rows] = ~_hidden(points[rows], corners, viewpoint, middle, margin=margin)
    return seen


def drop_unseen(part: Part, cloud: Cloud) -> tuple[Part, Cloud]:
    """The part and its cloud without the instances that no point of the cloud lies on, the others numbered anew.

    What a part knows of its surface beside the primitives, which has the old numbers, is left out.
    """
    kept = np.unique(cloud.labels[cloud.labels != BACKGROUND])
    number = np.full(len(part.primitives) + 1, BACKGROUND, np.int32)  # the last row is that of BACKGROUND
    number[kept] = np.arange(len(kept))
    rest = [None if values is None else values[kept] for values in (cloud.samples, cloud.sample_normals)]
    primitives = tuple(part.primitives[instance] for instance in kept)
    cloud = cloud._replace(labels=number[cloud.labels], samples=rest[0], sample_normals=rest[1])
    return part._replace(primitives=primitives, mesh=None, trims=None, areas=None, cloud=None), cloud


def scatter(
    generator: np.random.Generator, points: Float[np.ndarray, "n 3"], cloud: Cloud, *, share: float
) -> tuple[Float[np.ndarray, "n 3"], Cloud]:
    """The points as scanned with a share of them, at random rows, astray: uniform in the box and a tenth beyond it.

    In the cloud they belong to nothing (label BACKGROUND) and have a normal at random.
    """
    rows = generator.permutation(len(points))[: round(share * len(points))]
    low, high = points.min(axis=0), points.max(axis=0)
    points, labels, normals = points.copy(), cloud.labels.copy(), cloud.normals.copy()
    place = ENLARGED * (generator.random((len(rows), 3)) - 0.5)
    points[rows] = (low + high)[None] / 2.0 + place * (high - low)[None]
    labels[rows], normals[rows] = BACKGROUND, random_unit(generator, len(rows))
    return points, cloud._replace(labels=labels, normals=normals)


def random_unit(generator: np.random.Generator, num: int) -> Float[np.ndarray, "n 3"]:
    """Directions uniform on the sphere."""
    vectors = generator.standard_normal((num, 3))
    return vectors / np.sqrt(_dot(vectors, vectors))[:, None]


def _hidden(
    points: np.ndarray, corners: np.ndarray, viewpoint: np.ndarray, middle: np.ndarray, *, margin: float
) -> Bool[np.ndarray, "n"]:
    """Whether the way from the viewpoint to points that face it leads through the solid.

    Then it comes out of the solid before it ends, through a triangle that faces away. Triangles that face the
    viewpoint are not asked: those that a point itself lies on, or curved ones beside it, never hide it so.
    """
    edges = corners[:, 1:] - corners[:, :1]
    away = _dot(np.cross(edges[:, 0], edges[:, 1]), corners[:, 0] - viewpoint[None]) > 0.0
    picture, place = _project(corners[away], viewpoint, middle), _project(points, viewpoint, middle)
    origin, first, second = picture[:, 0], picture[:, 1] - picture[:, 0], picture[:, 2] - picture[:, 0]
    double_area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    flat = np.abs(double_area) <= 1e-14
    inverse = np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, double_area))
    triangle, row = _meetings(picture[:, :, :2], place[:, :2])
    triangle, row = triangle[~flat[triangle]], row[~flat[triangle]]
    x, y = (place[row, :2] - origin[triangle, :2]).T
    along_first = (x * second[triangle, 1] - y * second[triangle, 0]) * inverse[triangle]
    along_second = (y * first[triangle, 0] - x * first[triangle, 1]) * inverse[triangle]
    inside = (along_first >= 0.0) & (along_second >= 0.0) & (along_first + along_second <= 1.0)
    nearness = origin[triangle, 2] + along_first * first[triangle, 2] + along_second * second[triangle, 2]
    depth = 1.0 / place[row, 2]
    hidden = np.zeros(len(points), bool)
    hidden[row[inside & (nearness * (depth - margin) > 1.0)]] = True
    return hidden


def _project(points: Num[np.ndarray, "*m 3"], viewpoint: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """(..., 3): two coordinates in the picture and 1 / depth, which is linear on the picture of a triangle."""
    forward = middle - viewpoint
    forward = forward / _length(forward)
    right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= _length(right)
    seen = (points - viewpoint) @ np.stack([right, np.cross(forward, right), forward]).T
    seen[..., 2] = 1.0 / seen[..., 2]
    seen[..., :2] *= seen[..., 2:]
    return seen


def _meetings(
    triangles: Float[np.ndarray, "t 3 2"], places: Float[np.ndarray, "n 2"]
) -> tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]]:
    """Rows of triangles and of places that share a cell of a grid over the places."""
    if len(places) == 0 or len(triangles) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    low, side = places.min(axis=0), np.ptp(places, axis=0)
    scale = _CELLS / np.where(side > 0.0, side, 1.0)
    cell = np.clip(((places - low[None]) * scale[None]).astype(np.int64), 0, _CELLS - 1)
    cell = cell[:, 0] * _CELLS + cell[:, 1]
    order = np.argsort(cell, kind="stable")
    start = np.searchsorted(cell[order], np.arange(_CELLS**2 + 1))
    ends = [(triangles.min(axis=1) - low[None]) * scale[None], (triangles.max(axis=1) - low[None]) * scale[None]]
    touching = np.flatnonzero(np.all((ends[0] <= _CELLS) & (ends[1] >= 0.0), axis=1))
    first, last = (np.clip(np.floor(end[touching]).astype(np.int64), 0, _CELLS - 1) for end in ends)
    size = last - first + 1
    box, offset = _runs(size[:, 0] * size[:, 1])
    covered = (first[box, 0] + offset // size[box, 1]) * _CELLS + first[box, 1] + offset % size[box, 1]
    run, offset = _runs(start[covered + 1] - start[covered])
    return touching[box[run]], order[start[covered[run]] + offset]


def _runs(counts: Int[np.ndarray, "m"]) -> tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]]:
    """0 repeated counts[0] times, 1 repeated counts[1] times ..., and the place of each in its own run."""
    number = np.repeat(np.arange(len(counts)), counts)
    return number, np.arange(len(number)) - (np.cumsum(counts) - counts)[number]


def _corners(part: Part) -> np.ndarray:
    """The points that say how far the part reaches."""
    if part.mesh is not None:
        return part.mesh.vertices[part.mesh.faces.ravel()]
    if part.cloud is not None:
        return part.cloud.points
    raise ValueError(f"Part {part.name!r} has trimmed faces only, which cannot be sampled; store it with a mesh.")


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nc,nc->n", a, b)


def _length(vector: np.ndarray) -> float:
    return float(np.sqrt(vector @ vector))
