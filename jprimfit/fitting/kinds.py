"""The four kinds fitted to rows of a cloud, called from the host: centred, scaled, padded, compiled once per size.

A fit starts from the closed-form estimate of primitives/ and is polished by Levenberg-Marquardt on the distances
themselves. It runs in float32 on points that were shifted to their mean and divided by their size in float64, so that
no digit is lost far from the origin; the answer comes back as NumPy float64 in the frame of the cloud.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jprimfit.geometry import host
from jprimfit.primitives.table import MODULES, of
from jprimfit.programs import stored
from jprimfit.solvers import least_squares
from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

SIZE_CLASSES = (256, 8_192)  # points of a fit, padded with weight 0 up to the next; more are thinned out
# Steps of the polish: the closed form is exact for planes, and poor for a cone seen far from its apex.
NUM_STEPS = {"plane": 2, "sphere": 6, "cylinder": 10, "cone": 30}
STACK = 32  # primitives of one kind that are held against a cloud in one call


class Fitted(NamedTuple):
    """A primitive in the frame of the cloud, float64, and the rms distance of the points it was fitted to."""

    primitive: Primitive
    rms: float


class Cloud:
    """Points and normals on the device, padded to a power of two, against which primitives are held."""

    def __init__(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]):
        self.num_points = len(points)
        size = max(256, 1 << (self.num_points - 1).bit_length())
        self.points, self.normals = jnp.asarray(_padded(points, size)), jnp.asarray(_padded(normals, size))

    def agreement(self, primitive: Primitive) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Distance of every point to the primitive, and |cosine| between the point's normal and the primitive's."""
        distance, cosine = _one_agreement(as_float32(primitive), self.points, self.normals)
        return np.asarray(distance)[: self.num_points], np.asarray(cosine)[: self.num_points]

    def agreements(self, primitives: Sequence[Primitive]) -> tuple[Float[np.ndarray, "p n"], Float[np.ndarray, "p n"]]:
        """`agreement` with each of p primitives of any kinds."""
        distance, cosine = np.empty((2, len(primitives), self.num_points), np.float32)
        for kind in {primitive.kind for primitive in primitives}:
            rows = [row for row, primitive in enumerate(primitives) if primitive.kind == kind]
            for first in range(0, len(rows), STACK):
                chunk = rows[first : first + STACK]
                padded = chunk + chunk[:1] * (STACK - len(chunk))
                stack = jax.tree.map(lambda *fields: np.stack(fields), *(as_float32(primitives[row]) for row in padded))
                found = _agreements(stack, self.points, self.normals)
                distance[chunk], cosine[chunk] = (np.asarray(a)[: len(chunk), : self.num_points] for a in found)
        return distance, cosine


def fit(
    kind: str,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    rows: Int[np.ndarray, " r"],
    *,
    sample: int = SIZE_CLASSES[-1],
    start: Primitive | None = None,
    determined: bool = True,
) -> Fitted | None:
    """The least-squares primitive of one kind through the rows of a cloud; None where they do not determine it.

    sample: at most so many rows, taken at even steps, are looked at. start: polish this one (float64, of this kind)
    instead of the closed-form estimate, which hangs on the normals for cylinders and cones. determined=False: give
    any finite primitive, as a guess that more points may yet confirm.
    """
    if len(rows) > sample:
        rows = rows[np.linspace(0, len(rows) - 1, sample).astype(int)]
    chosen = points[rows]
    center = chosen.mean(axis=0)
    centred = chosen - center[None, :]
    size = float(np.sqrt(np.square(centred).sum(axis=1).mean()))
    if size == 0.0:
        return None
    room = next(size for size in SIZE_CLASSES if len(rows) <= size)
    weights = (np.arange(room) < len(rows)).astype(np.float32)
    arrays = _padded(centred / size, room), weights, _padded(normals[rows], room)
    if start is None:
        fitted, rms, finite, ok = _fit(*arrays, kind=kind)
        ok = finite & ok if determined else finite
    else:
        fitted, rms, ok = _polish(as_float32(move(start, -center / size, 1.0 / size)), *arrays)
    return Fitted(move(fitted, center, size), float(rms) * size) if bool(ok) else None


def normals(primitive: Primitive, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals of the primitive at the feet of the points."""
    padded = _padded(points, max(SIZE_CLASSES[0], 1 << (len(points) - 1).bit_length()))
    found = np.asarray(_normal(as_float32(primitive), padded))[: len(points)].astype(np.float64)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def distances(primitive: Primitive, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Unsigned distance of each point, to about 1e-7 of the size of the points or of the radius if that is larger."""
    center = points.mean(axis=0)
    size = float(np.abs(points - center).max()) or 1.0
    local = (points - center) / size
    cloud = Cloud(local, np.zeros_like(local))
    return size * cloud.agreement(move(primitive, -center / size, 1.0 / size))[0].astype(np.float64)


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


def as_float32(primitive: Primitive) -> Primitive:
    """The same fields in float32; NumPy arrays, which a jitted function takes faster than it could be handed others."""
    return type(primitive)(*(np.asarray(field, np.float32) for field in primitive))


def _padded(rows: Float[np.ndarray, "r 3"], size: int) -> Float[np.ndarray, "s 3"]:
    """float32, with zeros up to the size; np.pad takes ten times as long."""
    padded = np.zeros((size, 3), np.float32)
    padded[: len(rows)] = rows
    return padded


@stored
def _normal(primitive: Any, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return of(primitive).normal(primitive, points)


@stored
def _one_agreement(primitive: Any, points: Float[Array, "n 3"], normals: Float[Array, "n 3"]):
    return _agreement(primitive, points, normals)


def _agreement(primitive: Any, points: Float[Array, "n 3"], normals: Float[Array, "n 3"]):
    module = of(primitive)
    cosine = jnp.abs(jnp.sum(module.normal(primitive, points) * normals, axis=1))
    return module.distance(primitive, points), cosine


@stored
def _agreements(primitives: Any, points: Float[Array, "n 3"], normals: Float[Array, "n 3"]):
    return jax.vmap(_agreement, in_axes=(0, None, None))(primitives, points, normals)


@partial(stored, static_argnames="kind")
def _fit(points: Float[Array, "n 3"], weights: Float[Array, " n"], normals: Float[Array, "n 3"], *, kind: str):
    first = MODULES[kind].fit(points, weights, normals)
    polished, rms, finite = _descend(first.primitive, points, weights)
    return polished, rms, finite, first.ok


@stored
def _polish(start: Any, points: Float[Array, "n 3"], weights: Float[Array, " n"], normals: Float[Array, "n 3"]):
    return _descend(start, points, weights)


def descend(
    start: Any, points: Float[Array, "n 3"], weights: Float[Array, " n"], *, num_steps: int
) -> tuple[Any, least_squares.Solution, Bool[Array, ""]]:
    """Levenberg-Marquardt on the signed distances; the primitive in its gauge about the origin, and if it is finite."""
    module = of(start)
    solution = least_squares.minimise(
        lambda primitive: module.signed_distance(primitive, points),
        start,
        weights,
        retract_fn=module.retract,
        num_freedom=module.NUM_FREEDOM,
        num_steps=num_steps,
    )
    primitive = module.canonical(solution.state, jnp.zeros(3, points.dtype))
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(field)) for field in primitive]))
    return primitive, solution, finite & jnp.isfinite(solution.cost)


def _descend(
    start: Any, points: Float[Array, "n 3"], weights: Float[Array, " n"]
) -> tuple[Any, Float[Array, ""], Bool[Array, ""]]:
    primitive, solution, finite = descend(start, points, weights, num_steps=NUM_STEPS[start.kind])
    rms = jnp.sqrt(2.0 * solution.cost / jnp.sum(weights))
    return primitive, rms, finite & jnp.isfinite(rms)
