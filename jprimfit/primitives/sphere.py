"""Spheres: all x with |x - center| = radius. Fit: Cholesky of the ridge normal equations of the algebraic distance.

Signs: signed_distance is |x - center| - radius, positive outside. At the very center, where no direction is
distinguished, normal and project take the direction (0, 0, 1).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST, weighted_mean
from jprimfit.primitives.common import blurred_reciprocal, fit_round, frame_coordinates, standardise
from jprimfit.primitives.quadrics import Quadric
from jprimfit.types import Discrepancy, Fit, Instruments, Sphere

KIND = "sphere"
NUM_FREEDOM = 4
STEP_UNITS = (1, 1, 1, 1)  # powers of length


def fit(points: Float[Array, "n 3"], weights: Float[Array, " n"], normals: Float[Array, "n 3"]) -> Fit:
    """The sphere of least sum w (|p - center|^2 - radius^2)^2; the normals are not used.

    Under isotropic noise of standard deviation s the radius of a full sphere comes out as sqrt(r^2 + 3 s^2).
    Not ok: no weight, fewer than four distinct points, a plane. Then the center is the mean, the radius the rms
    distance from it.
    """
    standard = standardise(points, weights)
    mean = weighted_mean(standard.local, standard.weights)
    center, radius, ok = fit_round(standard.local - mean[None, :], standard.weights)
    return Fit(Sphere(standard.center + standard.scale * (mean + center), standard.scale * radius), ok)


def signed_distance(primitive: Sphere, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Length from the sphere to each point, positive outside."""
    return safe.norm(points - primitive.center[None, :]) - primitive.radius


def distance(primitive: Sphere, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Unsigned length from each point to the sphere."""
    return jnp.abs(signed_distance(primitive, points))


def normal(primitive: Sphere, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Gradient of signed_distance: the unit vector from the center through each point."""
    up = jnp.array([0, 0, 1], dtype=points.dtype)
    return safe.unit_or(points - primitive.center[None, :], up)


def project(primitive: Sphere, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """The nearest point of the sphere to each point."""
    return primitive.center[None, :] + primitive.radius * normal(primitive, points)


def sample(
    key: PRNGKeyArray, primitive: Sphere, *, num_points: int, extent: Float[Array, ""] | float
) -> Float[Array, "num_points 3"]:
    """Points spread evenly over the whole sphere; the extent is not used."""
    directions = safe.unit(jax.random.normal(key, (num_points, 3), primitive.center.dtype))
    return primitive.center[None, :] + primitive.radius * directions


def transform(
    primitive: Sphere, rotation: Float[Array, "3 3"], translation: Float[Array, "3"], scale: Float[Array, ""] | float
) -> Sphere:
    """The sphere after x -> scale * R x + translation."""
    center = scale * jnp.matmul(rotation, primitive.center, precision=HIGHEST) + translation
    return Sphere(center, scale * primitive.radius)


def discrepancy(a: Sphere, b: Sphere) -> Discrepancy:
    """Direction 0, distance between the centers, difference of the radii."""
    position = safe.norm(a.center - b.center)
    return Discrepancy(jnp.zeros_like(position), position, jnp.abs(a.radius - b.radius))


def retract(primitive: Sphere, step: Float[Array, "4"]) -> Sphere:
    """The sphere with its center moved by step[:3] and its radius by step[3]."""
    return Sphere(primitive.center + step[:3], primitive.radius + step[3])


def canonical(primitive: Sphere, anchor: Float[Array, "3"]) -> Sphere:
    """The sphere itself: its parameters are unique."""
    return primitive


def quadric(primitive: Sphere) -> Quadric:
    """|x - center|^2 - radius^2."""
    center, radius = primitive
    return Quadric(
        jnp.eye(3, dtype=center.dtype), jnp.ones_like(center), -2 * center, jnp.sum(center * center) - radius * radius
    )


def instruments(primitive: Sphere, points: Float[Array, "n 3"], variance: Float[Array, ""]) -> Instruments:
    """What distances say of center and radius: the direction from the center, and 1."""
    offset = frame_coordinates(points - primitive.center[None, :], jnp.eye(3, dtype=points.dtype))
    scale = jnp.broadcast_to(safe.divide(jnp.ones_like(primitive.radius), 2 * primitive.radius), points.shape[:1])
    shrink = scale * blurred_reciprocal(offset, variance)
    return Instruments((*(shrink * coordinate for coordinate in offset), scale), scale)


def sound(primitive: Sphere, points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Bool[Array, ""]:
    """Whether the radius is positive."""
    return primitive.radius > 0
