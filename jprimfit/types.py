"""The values that every other file speaks of: neighbourhoods and the four primitives.

All are NamedTuples of arrays, hence immutable JAX pytrees: they pass through jit, vmap and grad, and a function
that is written for one of them works on a stack of them under vmap. The shapes below are those of ONE item.
Axis letters: n points, m queries, k neighbours. Lengths are in the unit of the cloud, angles in radians.
"""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int


class Neighbors(NamedTuple):
    """Fixed-size neighbourhoods of m queries among n points.

    points[index[i, j]] is the j-th neighbour of queries[i]. Where mask is False the slot is padding: it repeats the
    first neighbour of the row (0 if the row has none), so that gathering with it stays in range.
    """

    index: Int[Array, "m k"]  # int32, rows of points
    sq_distance: Float[Array, "m k"]  # squared length; the first neighbour's in padding, 0 if the row has none
    mask: Bool[Array, "m k"]  # True = a neighbour, False = padding
    count: Int[Array, "m"]  # int32, points that qualified before the cap k: count > k says that some were left out


class Plane(NamedTuple):
    """All x with normal·x = offset; the normal is a unit vector whose largest component is positive."""

    normal: Float[Array, "3"]
    offset: Float[Array, ""]
    kind = "plane"


class Sphere(NamedTuple):
    """All x with |x - center| = radius."""

    center: Float[Array, "3"]
    radius: Float[Array, ""]
    kind = "sphere"


class Cylinder(NamedTuple):
    """All x at distance radius from the line center + t·axis; axis is a unit vector with positive largest component."""

    axis: Float[Array, "3"]
    center: Float[Array, "3"]  # the point of the axis nearest the mean of the segment
    radius: Float[Array, ""]
    kind = "cylinder"


class Cone(NamedTuple):
    """All x with angle(x - apex, axis) = half_angle: one nappe, the axis points from the apex into it."""

    axis: Float[Array, "3"]
    apex: Float[Array, "3"]
    half_angle: Float[Array, ""]  # in (0, pi/2)
    kind = "cone"


Primitive = Plane | Sphere | Cylinder | Cone


class Fit(NamedTuple):
    """A fitted primitive, and whether the points determined it; where ok is False the values are finite but mean nothing."""

    primitive: Primitive
    ok: Bool[Array, ""]


class Discrepancy(NamedTuple):
    """How far two primitives of one kind lie apart, free of sign and gauge."""

    direction: Float[Array, ""]  # angle between normals or axes, radians; 0 for spheres
    position: Float[Array, ""]  # length: offsets of planes, centres, apexes, or distance between the axes of cylinders
    size: Float[Array, ""]  # radii (length) or half-angles (radians); 0 for planes
