"""Planes: all x with normal·x = offset. Fit: the smallest eigenvector of the weighted, centred covariance.

Signs: signed_distance is normal·x - offset; the normal's largest component is positive. The pivot of a step is the
foot point normal * offset, the point of the plane nearest the origin.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST, eigen_smallest, frame_of, moments, orientation
from jprimfit.primitives.common import direction_determined, frame_coordinates, standardise, steer
from jprimfit.primitives.quadrics import Quadric
from jprimfit.types import Discrepancy, Fit, Instruments, Plane

KIND = "plane"
NUM_FREEDOM = 3
STEP_UNITS = (0, 0, 1)  # powers of length


def fit(points: Float[Array, "n 3"], weights: Float[Array, " n"], normals: Float[Array, "n 3"]) -> Fit:
    """The plane of least sum w (normal·p - offset)^2; the normals are not used.

    Not ok: no weight, equal or collinear points, or a blob whose thinnest direction is chance.
    """
    standard = standardise(points, weights)
    shape = moments(standard.local, standard.weights)
    normal, eigenvalues = eigen_smallest(shape.covariance)
    mean = standard.center + standard.scale * shape.mean
    ok = direction_determined(eigenvalues, standard.count)
    return Fit(Plane(normal, jnp.dot(normal, mean, precision=HIGHEST)), ok)


def signed_distance(primitive: Plane, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Length from the plane to each point, positive on the side of the normal."""
    return jnp.matmul(points, primitive.normal, precision=HIGHEST) - primitive.offset


def distance(primitive: Plane, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Unsigned length from each point to the plane."""
    return jnp.abs(signed_distance(primitive, points))


def normal(primitive: Plane, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Gradient of signed_distance: the plane's normal, once per point."""
    return jnp.broadcast_to(primitive.normal, points.shape)


def project(primitive: Plane, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """The nearest point of the plane to each point."""
    return points - signed_distance(primitive, points)[:, None] * primitive.normal[None, :]


def sample(
    key: PRNGKeyArray, primitive: Plane, *, num_points: int, extent: Float[Array, ""] | float
) -> Float[Array, "num_points 3"]:
    """Points spread evenly over the square of side 2 * extent about the foot point of the origin."""
    dtype = primitive.normal.dtype
    coordinates = extent * jax.random.uniform(key, (num_points, 2), dtype, minval=-1, maxval=1)
    foot = primitive.normal * primitive.offset
    return foot[None, :] + jnp.matmul(coordinates, frame_of(primitive.normal)[:2], precision=HIGHEST)


def transform(
    primitive: Plane, rotation: Float[Array, "3 3"], translation: Float[Array, "3"], scale: Float[Array, ""] | float
) -> Plane:
    """The plane after x -> scale * R x + translation, in the gauge (largest component of the normal positive)."""
    normal = jnp.matmul(rotation, primitive.normal, precision=HIGHEST)
    offset = scale * primitive.offset + jnp.dot(normal, translation, precision=HIGHEST)
    return canonical(Plane(normal, offset), translation)


def discrepancy(a: Plane, b: Plane) -> Discrepancy:
    """Angle between the normals up to sign, difference of the offsets (after aligning the signs); size 0."""
    agree = jnp.where(jnp.dot(a.normal, b.normal, precision=HIGHEST) < 0, -1, 1)
    position = jnp.abs(a.offset - agree * b.offset)
    return Discrepancy(safe.line_angle(a.normal, b.normal), position, jnp.zeros_like(position))


def retract(primitive: Plane, step: Float[Array, "3"]) -> Plane:
    """The plane tilted by step[:2] (radians) about its foot point and pushed along its normal by step[2]."""
    normal = steer(primitive.normal, frame_of(primitive.normal), step[:2])
    cosine = jnp.dot(normal, primitive.normal, precision=HIGHEST)
    return Plane(normal, primitive.offset * cosine + step[2])


def canonical(primitive: Plane, anchor: Float[Array, "3"]) -> Plane:
    """The same plane with the largest component of the normal positive; the anchor is not used."""
    sign = orientation(primitive.normal)
    return Plane(sign * primitive.normal, sign * primitive.offset)


def quadric(primitive: Plane) -> Quadric:
    """normal·x - offset."""
    normal = primitive.normal
    return Quadric(frame_of(normal), jnp.zeros_like(normal), normal, -primitive.offset)


def instruments(primitive: Plane, points: Float[Array, "n 3"], variance: Float[Array, ""]) -> Instruments:
    """What distances say of the tilts and the offset: the coordinates in the plane, and 1."""
    x, y, _ = frame_coordinates(points, frame_of(primitive.normal))
    one = jnp.ones_like(x)
    return Instruments((x, y, one), one)


def sound(primitive: Plane, points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Bool[Array, ""]:
    """Whether the parameters are those of a plane: always."""
    return jnp.ones((), bool)
