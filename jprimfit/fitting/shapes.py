"""Distances and normals of the four kinds on the host, and how distances change with a step: primitives/ in NumPy.

The same surfaces, signs and minimal steps as the modules of primitives/, for the many small fits of the segmentation,
where a compiled program would cost more to call, and far more to compile, than its arithmetic. Coordinates are (3, n),
each axis whole in memory. A step moves a surface; the distance of a point changes by minus the part of the surface's
motion along the normal there, which is one number along the whole normal. Host code in float64.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jprimfit.geometry import host
from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

TINY = np.finfo(float).tiny ** 0.5


class Linear(NamedTuple):
    """The signed distances and their derivatives by the step of `retract`, at step 0."""

    distance: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "p n"]


class _Around(NamedTuple):
    """Points about an axis."""

    height: Float[np.ndarray, " n"]  # along it, over the origin that was given
    radial: Float[np.ndarray, "3 n"]  # from it to the point
    radius: Float[np.ndarray, " n"]


def signed_distances(primitive: Primitive, coordinates: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
    """Length from the surface to each point, positive outside, or on the side of a plane's normal."""
    if isinstance(primitive, Plane):
        return primitive.normal @ coordinates - primitive.offset
    if isinstance(primitive, Sphere):
        return _length(coordinates - primitive.center[:, None]) - primitive.radius
    around = _around(primitive, coordinates)
    if isinstance(primitive, Cylinder):
        return around.radius - primitive.radius
    cosine, sine = math.cos(primitive.half_angle), math.sin(primitive.half_angle)
    above = around.radius * cosine - around.height * sine
    behind = around.height * cosine + around.radius * sine <= 0.0
    return np.where(behind, np.hypot(around.height, around.radius), above) if behind.any() else above


def distances_and_normals(
    primitive: Primitive, coordinates: Float[np.ndarray, "3 n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "3 n"]]:
    """The signed distances, and their gradient: the unit normal at the nearest point of the surface."""
    if isinstance(primitive, Plane):
        normal = np.broadcast_to(primitive.normal[:, None], coordinates.shape)
        return primitive.normal @ coordinates - primitive.offset, normal
    if isinstance(primitive, Sphere):
        offset = coordinates - primitive.center[:, None]
        length = _length(offset)
        return length - primitive.radius, _unit(offset, length, np.array([0.0, 0.0, 1.0]))
    around = _around(primitive, coordinates)
    outwards = _unit(around.radial, around.radius, host.frame_of(primitive.axis)[0])
    if isinstance(primitive, Cylinder):
        return around.radius - primitive.radius, outwards
    cosine, sine = math.cos(primitive.half_angle), math.sin(primitive.half_angle)
    distance, normal = around.radius * cosine - around.height * sine, outwards
    normal *= cosine
    normal -= sine * primitive.axis[:, None]
    behind = np.flatnonzero(around.height * cosine + around.radius * sine <= 0.0)
    if len(behind):
        offset = coordinates[:, behind] - primitive.apex[:, None]
        distance[behind] = length = _length(offset)
        normal[:, behind] = _unit(offset, length, -primitive.axis)
    return distance, normal


def linearised(primitive: Primitive, coordinates: Float[np.ndarray, "3 n"]) -> Linear:
    """The signed distances, and what a small step makes of them."""
    if isinstance(primitive, Plane):
        frame = host.frame_of(primitive.normal)
        x, y, _ = frame @ coordinates
        return Linear(primitive.normal @ coordinates - primitive.offset, np.stack([x, y, np.full_like(x, -1.0)]))
    if isinstance(primitive, Sphere):
        distance, normal = distances_and_normals(primitive, coordinates)
        return Linear(distance, -np.concatenate([normal, np.ones_like(normal[:1])]))
    frame = host.frame_of(primitive.axis)
    # A step moves either as a whole about this point of its axis; the cone's is the nearest to the origin.
    height = -float(primitive[1] @ primitive.axis) if isinstance(primitive, Cone) else 0.0
    at = frame @ (coordinates - (primitive[1] + height * primitive.axis)[:, None])
    radius = np.sqrt(at[0] * at[0] + at[1] * at[1])
    outwards = _unit(at[:2], radius, np.array([1.0, 0.0]))
    jacobian = np.empty((6 if isinstance(primitive, Cone) else 5, len(radius)))
    jacobian[4] = -1.0
    if isinstance(primitive, Cylinder):
        np.multiply(outwards, -at[2], out=jacobian[0:2])
        np.negative(outwards, out=jacobian[2:4])
        return Linear(radius - primitive.radius, jacobian)
    cosine, sine = math.cos(primitive.half_angle), math.sin(primitive.half_angle)
    slant = radius * sine + at[2] * cosine
    distance = radius * cosine - (at[2] + height) * sine
    np.multiply(outwards, -slant, out=jacobian[0:2])
    np.multiply(outwards, -cosine, out=jacobian[2:4])
    # The generator turns about its point at the height of that point of the axis.
    np.subtract(height * sine * math.tan(primitive.half_angle), slant, out=jacobian[5])
    behind = np.flatnonzero(slant + height * cosine <= 0.0)
    if len(behind) and sine:
        # Nearest is the apex, a height below that point, which the last two steps move along the axis.
        x, y, h = at[:, behind]
        distance[behind] = length = np.hypot(np.hypot(x, y), h + height)
        away = _unit(np.stack([x, y, h + height]), length, np.array([0.0, 0.0, -1.0]))
        jacobian[0:2, behind] = height * away[:2]
        jacobian[2:4, behind] = -away[:2]
        jacobian[4, behind] = away[2] / sine
        jacobian[5, behind] = -away[2] * height / (sine * cosine)
    return Linear(distance, jacobian)


def retract(primitive: Primitive, step: Float[np.ndarray, " p"]) -> Any:
    """`retract` of the kind's module: the surface, of the same kind, moved by a minimal step."""
    if isinstance(primitive, Sphere):
        return Sphere(primitive.center + step[:3], primitive.radius + step[3])
    frame = host.frame_of(primitive[0])
    axis = frame[2] + step[0] * frame[0] + step[1] * frame[1]
    axis = axis / math.sqrt(axis @ axis)
    if isinstance(primitive, Plane):
        return Plane(axis, primitive.offset * (axis @ primitive.normal) + step[2])
    shift = step[2] * frame[0] + step[3] * frame[1]
    if isinstance(primitive, Cylinder):
        return Cylinder(axis, primitive.center + shift, primitive.radius + step[4])
    height = -float(primitive.apex @ primitive.axis)
    anchor = primitive.apex + height * primitive.axis + shift
    radius = (height * math.sin(primitive.half_angle) + step[4]) / math.cos(primitive.half_angle)
    half_angle = primitive.half_angle + step[5]
    return Cone(axis, anchor - radius / np.tan(half_angle) * axis, half_angle)


def canonical(primitive: Primitive) -> Any:
    """`canonical` of the kind's module, with the origin as the anchor; of the same kind."""
    if isinstance(primitive, Sphere):
        return primitive
    axis = primitive[0]
    if isinstance(primitive, Plane):
        sign = host.orientation(axis)
        return Plane(sign * axis, sign * primitive.offset)
    if isinstance(primitive, Cylinder):
        foot = primitive.center - (primitive.center @ axis) * axis
        return Cylinder(host.orientation(axis) * axis, foot, primitive.radius)
    angle = primitive.half_angle
    if 0.0 <= angle <= math.pi / 2.0:
        return primitive
    return Cone(-axis, primitive.apex, np.float64(-angle if angle < 0.0 else math.pi - angle))


def _around(primitive: Cylinder | Cone, coordinates: np.ndarray) -> _Around:
    axis, origin = primitive[0], primitive[1]
    radial = coordinates - origin[:, None]
    height = axis @ radial
    radial -= axis[:, None] * height
    return _Around(height, radial, _length(radial))


def _length(vectors: Float[np.ndarray, "d n"]) -> Float[np.ndarray, " n"]:
    return np.sqrt(np.einsum("cn,cn->n", vectors, vectors))


def _unit(vectors: np.ndarray, length: np.ndarray, otherwise: np.ndarray) -> Float[np.ndarray, "d n"]:
    """The vectors at length 1; in their place, where they have none, another one."""
    unit = vectors / np.maximum(length, TINY)
    return np.where(length > TINY, unit, otherwise[:, None]) if length.min(initial=1.0) <= TINY else unit
