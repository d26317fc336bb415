"""The four kinds fitted to rows of a cloud, and held against it.

A fit starts from the closed form of the kind (closed.py) and is polished by Levenberg-Marquardt on the distances
themselves (descent.py), on points that were shifted to their mean and divided by their size, so that no digit is lost
far from the origin. NumPy in float64: nothing is compiled.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jprimfit.fitting import closed, descent, shapes
from jprimfit.geometry import host
from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

SAMPLE = 8_192  # rows that a fit looks at, at most
FEW = 256  # rows that are enough for a guess
# Steps of the polish: the closed form is exact for planes, and poor for a cone seen far from its apex.
NUM_STEPS = {"plane": 0, "sphere": 6, "cylinder": 10, "cone": 30}


class Fitted(NamedTuple):
    """A primitive in the frame of the cloud, and the rms distance of the points it was fitted to."""

    primitive: Primitive
    rms: float


class Cloud:
    """Points and normals against which primitives are held."""

    def __init__(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]):
        self.coordinates, self.normals = np.ascontiguousarray(points.T), np.ascontiguousarray(normals.T)

    def agreement(
        self, primitive: Primitive, rows: Int[np.ndarray, " m"] | None = None
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Distance of every point, or of some, to the primitive, and |cosine| between their normals and its own."""
        some = slice(None) if rows is None else rows
        distance, normal = shapes.distances_and_normals(primitive, self.coordinates[:, some])
        cosine = np.einsum("cn,cn->n", normal, self.normals[:, some])
        return np.abs(distance), np.abs(cosine)

    def agreements(self, primitives: Sequence[Primitive]) -> tuple[Float[np.ndarray, "p n"], Float[np.ndarray, "p n"]]:
        """`agreement` with each of p primitives."""
        found = np.empty((2, len(primitives), self.coordinates.shape[1]))
        for number, primitive in enumerate(primitives):
            found[:, number] = self.agreement(primitive)
        return found[0], found[1]


def fit(
    kind: str,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    rows: Int[np.ndarray, " r"],
    *,
    sample: int = SAMPLE,
    start: Primitive | None = None,
    determined: bool = True,
    worst: float = np.inf,
) -> Fitted | None:
    """The least-squares primitive of one kind through the rows of a cloud; None where they do not determine it.

    sample: at most so many rows, taken at even steps, are looked at. start: polish this one (of this kind) instead of
    the closed-form estimate, which hangs on the normals for cylinders and cones. determined=False: give any that is
    finite. worst: rms distance beyond which none is of use, and may be given unfinished.
    """
    if len(rows) > sample:
        rows = rows[np.linspace(0, len(rows) - 1, sample).astype(int)]
    chosen = points[rows]
    center = chosen.mean(axis=0)
    centred = chosen - center[None, :]
    size = float(np.sqrt(np.square(centred).sum(axis=1).mean()))
    if size == 0.0:
        return None
    coordinates = np.ascontiguousarray(centred.T / size)
    if start is None or kind == "plane":
        first = closed.fit(kind, coordinates, np.ascontiguousarray(normals[rows].T))
        if determined and not first.ok:
            return None
        begin = first.primitive
    else:
        begin = move(start, -center / size, 1.0 / size)
    found = descent.minimise(begin, coordinates, num_steps=NUM_STEPS[kind], worst=worst / size)
    return Fitted(move(found.primitive, center, size), found.rms * size) if found.ok else None


def normals(primitive: Primitive, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals of the primitive at the feet of the points."""
    return np.array(shapes.distances_and_normals(primitive, points.T)[1].T, order="C")


def distances(primitive: Primitive, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Unsigned distance of each point."""
    return np.abs(shapes.signed_distances(primitive, points.T))


def move(
    primitive: Primitive,
    shift: Float[np.ndarray, "3"],
    scale: float,
    rotation: Float[np.ndarray, "3 3"] | None = None,
) -> Primitive:
    """The primitive under x -> scale·R x + shift, in float64 on the host; R = 1 if no rotation is given.

    Normals and axes whose sign says nothing are turned back to the side that linalg.orient takes.
    """
    fields = [np.asarray(field, np.float64) for field in primitive]
    if rotation is not None:
        fields = [rotation @ field if field.shape == (3,) else field for field in fields]
        sign = host.orientation(fields[0])
        if isinstance(primitive, Plane):
            fields = [sign * field for field in fields]
        elif isinstance(primitive, Cylinder):
            fields[0] = sign * fields[0]
    if isinstance(primitive, Plane):
        normal = fields[0] / np.linalg.norm(fields[0])
        return Plane(normal, scale * fields[1] + normal @ shift)
    if isinstance(primitive, Sphere):
        return Sphere(scale * fields[0] + shift, scale * fields[1])
    axis = fields[0] / np.linalg.norm(fields[0])
    if isinstance(primitive, Cylinder):
        return Cylinder(axis, scale * fields[1] + shift, scale * fields[2])
    return Cone(axis, scale * fields[1] + shift, fields[2])
