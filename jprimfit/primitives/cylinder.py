"""Cylinders: all x at distance radius from the line center + t * axis. Fit: the axis from the normals, then a circle.

Signs: signed_distance is the distance from the axis minus radius, positive outside; the axis' largest component is
positive. On the axis itself, where no direction is distinguished, normal and project take the first row of the axis'
frame (linalg.frame_of).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST, eigen_smallest, frame_of, orient, weighted_mean
from jprimfit.primitives.common import (
    blurred_reciprocal,
    direction_determined,
    fit_round,
    frame_coordinates,
    standardise,
    steer,
)
from jprimfit.primitives.quadrics import Quadric
from jprimfit.types import Cylinder, Discrepancy, Fit, Instruments

KIND = "cylinder"
NUM_FREEDOM = 5
STEP_UNITS = (0, 0, 1, 1, 1)  # powers of length


def fit(points: Float[Array, "n 3"], weights: Float[Array, " n"], normals: Float[Array, "n 3"]) -> Fit:
    """Axis = the direction most nearly perpendicular to all normals, then the algebraic circle across it.

    The normals are unit vectors of any sign; the axis minimises sum w (normal·axis)^2 and follows from them alone.
    The center is the axis point nearest the weighted mean. Not ok: no weight, a plane (all normals alike), a sphere
    (normals in all directions), points on one line.
    """
    standard = standardise(points, weights)
    weighted_normals = standard.weights[:, None] * normals
    axis, eigenvalues = eigen_smallest(jnp.matmul(weighted_normals.T, normals, precision=HIGHEST))
    mean = weighted_mean(standard.local, standard.weights)
    across = frame_of(axis)[:2]
    plane_points = jnp.matmul(standard.local - mean[None, :], across.T, precision=HIGHEST)
    plane_center, radius, circle_ok = fit_round(plane_points, standard.weights)
    center = mean + jnp.matmul(plane_center, across, precision=HIGHEST)
    ok = direction_determined(eigenvalues, standard.count) & circle_ok
    return Fit(Cylinder(axis, standard.center + standard.scale * center, standard.scale * radius), ok)


def signed_distance(primitive: Cylinder, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Length from the cylinder to each point, positive outside."""
    return safe.norm(_split(primitive, points)[1]) - primitive.radius


def distance(primitive: Cylinder, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Unsigned length from each point to the cylinder."""
    return jnp.abs(signed_distance(primitive, points))


def normal(primitive: Cylinder, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Gradient of signed_distance: the unit vector from the axis through each point."""
    return safe.unit_or(_split(primitive, points)[1], frame_of(primitive.axis)[0])


def project(primitive: Cylinder, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """The nearest point of the cylinder to each point."""
    height, _ = _split(primitive, points)
    foot = primitive.center[None, :] + height[:, None] * primitive.axis[None, :]
    return foot + primitive.radius * normal(primitive, points)


def sample(
    key: PRNGKeyArray, primitive: Cylinder, *, num_points: int, extent: Float[Array, ""] | float
) -> Float[Array, "num_points 3"]:
    """Points spread evenly over the tube of height 2 * extent about the center."""
    height_key, angle_key = jax.random.split(key)
    dtype = primitive.axis.dtype
    height = extent * jax.random.uniform(height_key, (num_points,), dtype, minval=-1, maxval=1)
    turn = jax.random.uniform(angle_key, (num_points,), dtype, maxval=2 * jnp.pi)
    local = jnp.stack([primitive.radius * jnp.cos(turn), primitive.radius * jnp.sin(turn), height], axis=1)
    return primitive.center[None, :] + jnp.matmul(local, frame_of(primitive.axis), precision=HIGHEST)


def transform(
    primitive: Cylinder, rotation: Float[Array, "3 3"], translation: Float[Array, "3"], scale: Float[Array, ""] | float
) -> Cylinder:
    """The cylinder after x -> scale * R x + translation, its axis with positive largest component."""
    axis = orient(jnp.matmul(rotation, primitive.axis, precision=HIGHEST))
    center = scale * jnp.matmul(rotation, primitive.center, precision=HIGHEST) + translation
    return Cylinder(axis, center, scale * primitive.radius)


def discrepancy(a: Cylinder, b: Cylinder) -> Discrepancy:
    """Angle between the axes up to sign, distance between them, difference of the radii.

    The distance is the mean of the distances of either center from the other's axis: for parallel axes the distance of
    the lines, for others that near the segments, where that of the lines would miss axes that cross far away.
    """
    offset_from_a = safe.norm(_split(a, b.center[None, :])[1])[0]
    offset_from_b = safe.norm(_split(b, a.center[None, :])[1])[0]
    position = (offset_from_a + offset_from_b) / 2
    return Discrepancy(safe.line_angle(a.axis, b.axis), position, jnp.abs(a.radius - b.radius))


def retract(primitive: Cylinder, step: Float[Array, "5"]) -> Cylinder:
    """The cylinder with its axis tilted by step[:2] (radians) about its center, this shifted across by step[2:4].

    step[4] is added to the radius. A shift along the axis is left out: it changes nothing.
    """
    frame = frame_of(primitive.axis)
    center = primitive.center + step[2] * frame[0] + step[3] * frame[1]
    return Cylinder(steer(primitive.axis, frame, step[:2]), center, primitive.radius + step[4])


def canonical(primitive: Cylinder, anchor: Float[Array, "3"]) -> Cylinder:
    """The same cylinder with the axis' largest component positive and its center the axis point nearest the anchor."""
    height, _ = _split(primitive, anchor[None, :])
    return Cylinder(orient(primitive.axis), primitive.center + height[0] * primitive.axis, primitive.radius)


def _split(primitive: Cylinder, points: Float[Array, "n 3"]) -> tuple[Float[Array, " n"], Float[Array, "n 3"]]:
    """Height of each point over the center along the axis, and its vector from the axis."""
    offset = points - primitive.center[None, :]
    height = jnp.matmul(offset, primitive.axis, precision=HIGHEST)
    return height, offset - height[:, None] * primitive.axis[None, :]


def quadric(primitive: Cylinder) -> Quadric:
    """|v|^2 - (axis·v)^2 - radius^2 with v = x - center."""
    axis, center, radius = primitive
    across = center - jnp.dot(center, axis, precision=HIGHEST) * axis
    curvature = jnp.array([1, 1, 0], axis.dtype)
    return Quadric(frame_of(axis), curvature, -2 * across, jnp.sum(across * across) - radius * radius)


def instruments(primitive: Cylinder, points: Float[Array, "n 3"], variance: Float[Array, ""]) -> Instruments:
    """What distances say of tilts, shifts and radius: height times direction from the axis, direction, and 1."""
    x, y, height = frame_coordinates(points - primitive.center[None, :], frame_of(primitive.axis))
    scale = jnp.broadcast_to(safe.divide(jnp.ones_like(primitive.radius), 2 * primitive.radius), x.shape)
    shrink = scale * blurred_reciprocal((x, y), variance)
    return Instruments((height * shrink * x, height * shrink * y, shrink * x, shrink * y, scale), scale)


def sound(primitive: Cylinder, points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Bool[Array, ""]:
    """Whether the radius is positive."""
    return primitive.radius > 0
