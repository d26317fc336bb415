"""The values that every other file speaks of: neighbourhoods and the four primitives.

All are NamedTuples of arrays, hence immutable JAX pytrees: they pass through jit, vmap and grad, and a function
that is written for one of them works on a stack of them under vmap. The shapes below are those of ONE item. The
arrays are JAX's while something is computed and NumPy's, float64, in an answer: Any stands for both, and nothing here
loads JAX, so that a stored answer opens without it.
Axis letters: n points, m queries, k neighbours. Lengths are in the unit of the cloud, angles in radians.
"""

from typing import Any, NamedTuple

from jaxtyping import Bool, Float, Int


class Neighbors(NamedTuple):
    """Fixed-size neighbourhoods of m queries among n points.

    points[index[i, j]] is the j-th neighbour of queries[i]. Where mask is False the slot is padding: it repeats the
    first neighbour of the row (0 if the row has none), so that gathering with it stays in range.
    """

    index: Int[Any, "m k"]  # int32, rows of points
    sq_distance: Float[Any, "m k"]  # squared length; the first neighbour's in padding, 0 if the row has none
    mask: Bool[Any, "m k"]  # True = a neighbour, False = padding
    count: Int[Any, "m"]  # int32, points that qualified before the cap k: count > k says that some were left out


class Plane(NamedTuple):
    """All x with normal·x = offset; the normal is a unit vector whose largest component is positive."""

    normal: Float[Any, "3"]
    offset: Float[Any, ""]
    kind = "plane"


class Sphere(NamedTuple):
    """All x with |x - center| = radius."""

    center: Float[Any, "3"]
    radius: Float[Any, ""]
    kind = "sphere"


class Cylinder(NamedTuple):
    """All x at distance radius from the line center + t·axis; axis is a unit vector with positive largest component."""

    axis: Float[Any, "3"]
    center: Float[Any, "3"]  # the point of the axis nearest the mean of the segment
    radius: Float[Any, ""]
    kind = "cylinder"


class Cone(NamedTuple):
    """All x with angle(x - apex, axis) = half_angle: one nappe, the axis points from the apex into it."""

    axis: Float[Any, "3"]
    apex: Float[Any, "3"]
    half_angle: Float[Any, ""]  # in (0, pi/2)
    kind = "cone"


Primitive = Plane | Sphere | Cylinder | Cone


class Loop(NamedTuple):
    """A closed boundary of a flat face: a circle, or the corners of a polygon in order."""

    corners: Float[Any, "k 3"]  # empty where it is a circle
    center: Float[Any, "3"] | None = None  # of the circle
    radius: float | None = None


class Feature(NamedTuple):
    """What a drawing says of one primitive: how far it reaches, hole or boss, how well its points fit and tell it.

    None stands for what the kind does not have or the points do not tell. Extents are those of the surface that was
    seen, ends where its points end. Lengths in the unit of the points, angles in radians.
    """

    num_points: int
    rms: float  # root of the mean squared distance of the points; NaN without points
    largest_deviation: float  # signed distance of the point farthest off: a single stray point decides; NaN without
    position: Float[Any, "3"]  # plane: middle of its box; sphere: center; cylinder, cone: axis, midway between the ends
    area: float  # of the trimmed surface
    length: float | None = None  # plane: longer side of its smallest box; cylinder, cone: along the axis
    width: float | None = None  # plane: shorter side
    ends: Float[Any, "2 3"] | None = None  # cylinder, cone: the points of the axis where the surface ends
    end_radii: tuple[float, float] | None = None  # cylinder, cone: there
    arc: float | None = None  # cylinder, cone: the turn without the widest gap; 2 pi = all round
    solid_angle: float | None = None  # sphere: area / radius^2; 4 pi = all of it
    outline: tuple[Loop, ...] = ()  # plane: outer boundaries counter-clockwise about the normal, holes clockwise
    is_hole: bool | None = None  # sphere, cylinder, cone: whether the material is outside; None = not known
    standard_errors: dict[str, float] | None = None  # see Scene.features
    warning: str = ""  # why not to rely on it; empty = nothing speaks against it


class Fit(NamedTuple):
    """A fitted primitive, and whether the points determined it; where ok is False its values are finite, no more."""

    primitive: Primitive
    ok: Bool[Any, ""]


class Instruments(NamedTuple):
    """What the distances of n points say of the p unknowns of a primitive: weights of an estimating equation."""

    weights: tuple[Float[Any, "n"], ...]  # p of them: derivative of the distance by the step, times scale
    scale: Float[Any, "n"]  # 1 / length of the quadric's gradient at the foot of each point


class Discrepancy(NamedTuple):
    """How far two primitives of one kind lie apart, free of sign and gauge."""

    direction: Float[Any, ""]  # angle between normals or axes, radians; 0 for spheres
    position: Float[Any, ""]  # length: offsets of planes, centres, apexes, or distance between the axes of cylinders
    size: Float[Any, ""]  # radii (length) or half-angles (radians); 0 for planes


class Prediction(NamedTuple):
    """What a network says of each of n points. A head that it lacks leaves None."""

    normals: Float[Any, "n 3"]  # unit, of either sign
    type_logits: Float[Any, "n 4"]  # in the order of primitives/table.KINDS
    features: Float[Any, "n c"]  # of the last shared layer: what a classifier of whole segments pools
    membership_logits: Float[Any, "n s"] | None = None  # head "slots": before the softmax over s slots
    embedding: Float[Any, "n e"] | None = None  # head "prototype": points of one instance lie close together
    segment_type_logits: Float[Any, "s 4"] | None = None  # types "pooled": of the segments the network was asked for


class Truth(NamedTuple):
    """What is known of n points and of the instances they lie on, i of them at most.

    An instance k without any point among the n still counts (field.md, 3.3) as long as instance_mask[k] is True.
    """

    mask: Bool[Any, "n"]  # False = padding
    normals: Float[Any, "n 3"]  # unit, of the clean surface
    labels: Int[Any, "n"]  # int32, instance of each point; -1 = background or padding
    instance_mask: Bool[Any, "i"]  # True = an instance, False = padding
    kind: Int[Any, "i"]  # int32, position in primitives/table.KINDS; 0 in padding
    axis: Float[Any, "i 3"]  # plane normal, axis of cylinder or cone, unit; 0 for spheres and padding
    samples: Float[Any, "i m 3"]  # clean points uniform on each instance's surface; m may be 0 where no loss needs them
