"""Cones: all x with angle(x - apex, axis) = half_angle, one nappe. Fit: apex, then axis, then half-angle.

In the half-plane through the axis a point has a height along it and a radius from it; the generator is the ray
(cos, sin) of half_angle, `along` the coordinate on it. Where along < 0 the nearest surface point is the apex. Signs:
signed_distance is positive outside. On the axis, where no direction is distinguished, normal and project take the
first row of the axis' frame (linalg.frame_of), at the apex normal is -axis.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST, eigen_smallest, frame_of, moments, ridge_solve, weighted_mean
from jprimfit.primitives.common import (
    blurred_reciprocal,
    direction_determined,
    frame_coordinates,
    position_determined,
    standardise,
    steer,
)
from jprimfit.primitives.quadrics import Quadric
from jprimfit.types import Cone, Discrepancy, Fit, Instruments

KIND = "cone"
NUM_FREEDOM = 6
STEP_UNITS = (0, 0, 1, 1, 1, 0)  # powers of length
GRAPH_UNITS = (1, 0, 0, -1, -1, -2)

MIN_HALF_ANGLE = 1e-3  # radians; as far from a right angle
MAX_HALF_ANGLE = math.pi / 2 - MIN_HALF_ANGLE
# A plane with noisy normals looks like a cone of nearly a right half-angle whose points lie on both sides of the apex:
# at least three quarters of the heights must agree in sign.
MIN_ONE_SIDED = 0.5
# (Standard deviations)^2 within which the weight of points levels off towards the apex. With 9 the few points next to
# it decided: of quarters with 5 % noise one in twenty was lost, and the covariance was too small for the others.
SQ_APEX_BLUR = 400.0
MIN_ON_NAPPE = 0.9  # of the weight: more than noise at the apex can leave behind it


def fit(points: Float[Array, "n 3"], weights: Float[Array, " n"], normals: Float[Array, "n 3"]) -> Fit:
    """Apex = the point where the tangent planes meet, axis = the direction the normals share, half-angle = a mean.

    The normals are unit vectors of any sign. The apex minimises sum w (normal·(apex - p))^2. With all normals turned
    outwards, normal·axis is one constant, so the axis is the smallest direction of the centred normals; it points to
    the side of the points. The half-angle is the weighted mean angle between it and p - apex, without sign.
    Not ok: no weight, a plane, a cylinder (no apex), a sphere, points on both sides of the apex, a half-angle at its
    bounds.
    """
    standard = standardise(points, weights)
    weights = standard.weights
    mean = weighted_mean(standard.local, weights)
    centred = standard.local - mean[None, :]
    tangent = ridge_solve(normals, jnp.sum(normals * centred, axis=1), weights)
    rays = centred - tangent.x[None, :]
    directions = safe.unit(rays)
    axis, eigenvalues = eigen_smallest(moments(_turned_outwards(normals, directions, weights), weights).covariance)
    cosines = jnp.matmul(directions, axis, precision=HIGHEST)
    sines = safe.norm(directions - cosines[:, None] * axis[None, :])
    half_angle = jnp.sum(weights * safe.arctan2(sines, jnp.abs(cosines)))
    one_sided = jnp.abs(jnp.sum(weights * cosines)) > MIN_ONE_SIDED * jnp.sum(weights * jnp.abs(cosines))
    ok = position_determined(tangent, jnp.ones((), points.dtype)) & direction_determined(eigenvalues, standard.count)
    ok = ok & one_sided & (half_angle > MIN_HALF_ANGLE) & (half_angle < MAX_HALF_ANGLE)
    axis = jnp.where(jnp.sum(weights * cosines) < 0, -axis, axis)
    apex = standard.center + standard.scale * (mean + tangent.x)
    return Fit(Cone(axis, apex, jnp.clip(half_angle, MIN_HALF_ANGLE, MAX_HALF_ANGLE)), ok)


def _turned_outwards(
    normals: Float[Array, "n 3"], directions: Float[Array, "n 3"], weights: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """The normals with the signs that a cone with its apex at the origin of the directions would give them.

    The mean direction lies inside the cone, hence behind every tangent plane, however partial the patch is.
    """
    inside = jax.lax.stop_gradient(weighted_mean(directions, weights))
    inwards = jnp.matmul(jax.lax.stop_gradient(normals), inside, precision=HIGHEST) > 0
    return jnp.where(inwards[:, None], -normals, normals)


class _Profile(NamedTuple):
    """Points in the half-plane through the axis."""

    along: Float[Array, " n"]  # coordinate on the generator's line, from the apex
    above: Float[Array, " n"]  # signed distance from the generator's line, positive outside
    outwards: Float[Array, "n 3"]  # unit vector from the axis to the point
    offset: Float[Array, "n 3"]  # from the apex to the point


def _profile(primitive: Cone, points: Float[Array, "n 3"]) -> _Profile:
    offset = points - primitive.apex[None, :]
    height = jnp.matmul(offset, primitive.axis, precision=HIGHEST)
    radial = offset - height[:, None] * primitive.axis[None, :]
    radius = safe.norm(radial)
    cosine, sine = jnp.cos(primitive.half_angle), jnp.sin(primitive.half_angle)
    outwards = safe.unit_or(radial, frame_of(primitive.axis)[0])
    return _Profile(height * cosine + radius * sine, radius * cosine - height * sine, outwards, offset)


def signed_distance(primitive: Cone, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Length from the cone to each point, positive outside; |x - apex| for points behind the apex."""
    profile = _profile(primitive, points)
    return jnp.where(profile.along > 0, profile.above, safe.norm(profile.offset))


def distance(primitive: Cone, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Unsigned length from each point to the cone: |x - apex| * sin(min(|angle - half_angle|, pi/2))."""
    return jnp.abs(signed_distance(primitive, points))


def normal(primitive: Cone, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Gradient of signed_distance: across the generator, or away from the apex for points behind it."""
    profile = _profile(primitive, points)
    cosine, sine = jnp.cos(primitive.half_angle), jnp.sin(primitive.half_angle)
    across = cosine * profile.outwards - sine * primitive.axis[None, :]
    away = safe.unit_or(profile.offset, -primitive.axis)
    return jnp.where(profile.along[:, None] > 0, across, away)


def project(primitive: Cone, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """The nearest point of the cone to each point; the apex for points behind it."""
    profile = _profile(primitive, points)
    cosine, sine = jnp.cos(primitive.half_angle), jnp.sin(primitive.half_angle)
    generator = cosine * primitive.axis[None, :] + sine * profile.outwards
    return primitive.apex[None, :] + jnp.maximum(profile.along, 0)[:, None] * generator


def sample(
    key: PRNGKeyArray, primitive: Cone, *, num_points: int, extent: Float[Array, ""] | float
) -> Float[Array, "num_points 3"]:
    """Points spread evenly over the surface from the apex to height extent above it."""
    height_key, angle_key = jax.random.split(key)
    dtype = primitive.axis.dtype
    # The circumference, so the area per length of generator, grows linearly from the apex.
    height = extent * jnp.sqrt(jax.random.uniform(height_key, (num_points,), dtype))
    turn = jax.random.uniform(angle_key, (num_points,), dtype, maxval=2 * jnp.pi)
    radius = height * jnp.tan(primitive.half_angle)
    local = jnp.stack([radius * jnp.cos(turn), radius * jnp.sin(turn), height], axis=1)
    return primitive.apex[None, :] + jnp.matmul(local, frame_of(primitive.axis), precision=HIGHEST)


def transform(
    primitive: Cone, rotation: Float[Array, "3 3"], translation: Float[Array, "3"], scale: Float[Array, ""] | float
) -> Cone:
    """The cone after x -> scale * R x + translation."""
    axis = jnp.matmul(rotation, primitive.axis, precision=HIGHEST)
    apex = scale * jnp.matmul(rotation, primitive.apex, precision=HIGHEST) + translation
    return Cone(axis, apex, primitive.half_angle)


def discrepancy(a: Cone, b: Cone) -> Discrepancy:
    """Angle between the axes, distance between the apexes, difference of the half-angles.

    The angle is in [0, pi]: the sign of a cone's axis is no gauge, opposite nappes are different surfaces.
    """
    size = jnp.abs(a.half_angle - b.half_angle)
    return Discrepancy(safe.angle(a.axis, b.axis), safe.norm(a.apex - b.apex), size)


def retract(primitive: Cone, step: Float[Array, "6"]) -> Cone:
    """The cone tilted by step[:2] (radians) about the axis point nearest the origin, this shifted across by step[2:4].

    step[4] pushes the surface along its normal, step[5] opens the half-angle about the generator's point at the height
    of that axis point. So a step is well defined even where the apex is far away and hardly known.
    """
    axis, apex, half_angle = primitive
    frame = frame_of(axis)
    height = -jnp.dot(apex, axis, precision=HIGHEST)
    anchor = apex + height * axis + step[2] * frame[0] + step[3] * frame[1]
    push = height * jnp.sin(half_angle) + step[4]
    axis, half_angle = steer(axis, frame, step[:2]), half_angle + step[5]
    radius = safe.divide(push, jnp.cos(primitive.half_angle))
    return Cone(axis, anchor - safe.divide(radius, jnp.tan(half_angle)) * axis, half_angle)


def graph(primitive: Cone, like: Cone) -> Float[Array, "6"]:
    """The cone as heights z over a tangent plane of another one: z, z_g, z_t, z_tt, z_gt, z_gtt where that is touched.

    That point is the other cone's nearest to the origin; g runs along its generator, away from the apex, t across it, z
    along the normal. Six numbers that tell a cone, and of which a patch is nearly a linear function, so that errors of
    noise are normal in them. Not finite where the normal through that point misses the cone.
    """
    foot, plane = _tangent_plane(like)
    # Along the normal q(z) = f at foot + z n is of degree two, with the slope -2 b.
    square = jnp.cos(primitive.half_angle) ** 2
    form = jnp.outer(primitive.axis, primitive.axis) - square * jnp.eye(3, dtype=square.dtype)  # x·form x = 0
    offset = foot - primitive.apex
    turned = jnp.matmul(jnp.matmul(plane, form, precision=HIGHEST), plane.T, precision=HIGHEST)
    linear = jnp.matmul(plane, jnp.matmul(form, offset, precision=HIGHEST), precision=HIGHEST)
    level, across = jnp.dot(offset, jnp.matmul(form, offset, precision=HIGHEST), precision=HIGHEST), linear[2]
    root = jnp.sqrt(across * across - turned[2, 2] * level)
    z = -level / (across + jnp.where(across < 0, -root, root))
    # Implicit differentiation of f(g, t, z) = 0, whose third derivatives are 0; halves of its first and second ones.
    by_g, by_t, by_z = linear + turned[:, 2] * z
    z_g, z_t = -by_g / by_z, -by_t / by_z
    along, aside = turned[0, 2] + turned[2, 2] * z_g, turned[1, 2] + turned[2, 2] * z_t  # of by_z with g and t
    z_tt = -(turned[1, 1] + turned[1, 2] * z_t + aside * z_t) / by_z
    z_gt = -(turned[0, 1] + turned[0, 2] * z_t + aside * z_g) / by_z
    z_gtt = -(2 * aside * z_gt + along * z_tt) / by_z
    return jnp.stack([z, z_g, z_t, z_tt, z_gt, z_gtt])


def _tangent_plane(primitive: Cone) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """The point of the cone nearest the origin, and the rows g, t, normal there."""
    profile = _profile(primitive, jnp.zeros((1, 3), primitive.axis.dtype))
    cosine, sine = jnp.cos(primitive.half_angle), jnp.sin(primitive.half_angle)
    outwards = profile.outwards[0]
    generator, normal = cosine * primitive.axis + sine * outwards, cosine * outwards - sine * primitive.axis
    foot = primitive.apex + profile.along[0] * generator
    return foot, jnp.stack([generator, jnp.cross(normal, generator), normal])


def canonical(primitive: Cone, anchor: Float[Array, "3"]) -> Cone:
    """The same cone with its half-angle in [0, pi/2]: a step may turn it inside out. The anchor is not used."""
    axis, apex, half_angle = primitive
    turned = (half_angle > math.pi / 2) | (half_angle < 0)
    inside = jnp.where(half_angle < 0, -half_angle, math.pi - half_angle)
    return Cone(jnp.where(turned, -axis, axis), apex, jnp.where(turned, inside, half_angle))


def quadric(primitive: Cone) -> Quadric:
    """cos^2 |u|^2 - L^2 with u the vector from the axis and L = sin axis·(x - apex).

    Written about the axis point nearest the origin, so that a far apex costs no digits.
    """
    axis, apex, half_angle = primitive
    cosine, sine = jnp.cos(half_angle), jnp.sin(half_angle)
    height = -sine * jnp.dot(apex, axis, precision=HIGHEST)
    across = apex - jnp.dot(apex, axis, precision=HIGHEST) * axis
    curvature = jnp.stack([cosine**2, cosine**2, -(sine**2)])
    vector = -2 * (cosine**2 * across + height * sine * axis)
    return Quadric(frame_of(axis), curvature, vector, cosine**2 * jnp.sum(across * across) - height * height)


def instruments(primitive: Cone, points: Float[Array, "n 3"], variance: Float[Array, ""]) -> Instruments:
    """What distances say of tilts, shifts, push and half-angle: all constant along the surface's normals.

    With s the slant, measured from the height of the axis point nearest the origin, and c the direction from the axis:
    s c, c, 1, s. The gradient at a point's foot is 2 L long, L growing in proportion to the distance from the apex.
    """
    axis, apex, half_angle = primitive
    cosine, sine = jnp.cos(half_angle), jnp.sin(half_angle)
    height = -jnp.dot(apex, axis, precision=HIGHEST)
    x, y, h = frame_coordinates(points - (apex + height * axis)[None, :], frame_of(axis))
    reciprocal, push = blurred_reciprocal((x, y), variance), height * sine
    radius = 1 / reciprocal
    slant = radius * sine + h * cosine - safe.divide(push * sine, cosine)
    length = cosine * (cosine * push + sine * cosine * h + sine * sine * radius)
    floor = jnp.finfo(points.dtype).tiny ** 0.5
    scale = length / (length * length + SQ_APEX_BLUR * variance * (sine * cosine) ** 2 + floor) / 2
    shrink = scale * reciprocal
    return Instruments((slant * shrink * x, slant * shrink * y, shrink * x, shrink * y, scale, slant * scale), scale)


def sound(primitive: Cone, points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Bool[Array, ""]:
    """Whether the half-angle is acute and nearly all points lie on the side of the apex where the nappe is."""
    inside = jnp.matmul(points - primitive.apex[None, :], primitive.axis, precision=HIGHEST) > 0
    angle = primitive.half_angle
    return (angle > MIN_HALF_ANGLE) & (angle < MAX_HALF_ANGLE) & (jnp.sum(weights * inside) > MIN_ON_NAPPE)
