"""Rotations as 3 x 3 matrices that act on columns, and similarity transforms x -> scale * R x + translation.

Rotation by an angle about an axis: Rodrigues' formula. Uniform random rotations: a unit quaternion drawn from the
normal distribution (Shoemake 1992). Clouds hold points as rows, so a rotated cloud is points @ R.T.
"""

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PRNGKeyArray

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST, frame_of


def rotation_about(axis: Float[Array, "3"], angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Rotation by angle (radians, right-handed) about an axis of any length; the identity for the zero axis."""
    cross = _cross_matrix(safe.unit(axis))
    square = jnp.matmul(cross, cross, precision=HIGHEST)
    return jnp.eye(3, dtype=axis.dtype) + jnp.sin(angle) * cross + (1 - jnp.cos(angle)) * square


def rotation_between(source: Float[Array, "3"], target: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The rotation by the least angle that turns the direction of source into that of target.

    It is the product of the reflections across source and across the middle of the two, hence exactly a rotation.
    Opposite directions leave the axis open: then a half turn about some axis perpendicular to source. Not for zero
    vectors.
    """
    source, target = safe.unit(source), safe.unit(target)
    between = source + target
    # The half turn stands for directions that are opposite but for 3e-4 rad (float32), whose middle is rounding.
    opposite = jnp.sum(between * between) < jnp.finfo(source.dtype).eps
    middle = jnp.where(opposite, frame_of(source)[0], safe.unit(jnp.where(opposite, source, between)))
    return jnp.matmul(_reflection(middle), _reflection(source), precision=HIGHEST)


def random_rotation(key: PRNGKeyArray, *, dtype: DTypeLike = jnp.float32) -> Float[Array, "3 3"]:
    """A rotation drawn uniformly (Haar measure) from all rotations."""
    w, x, y, z = safe.unit(jax.random.normal(key, (4,), dtype))
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def apply(
    points: Float[Array, "n 3"],
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    scale: Float[Array, ""] | float = 1.0,
) -> Float[Array, "n 3"]:
    """Each point x becomes scale * R x + translation; normals want translation 0 and scale 1."""
    return scale * jnp.matmul(points, rotation.T, precision=HIGHEST) + translation[None, :]


def _cross_matrix(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    x, y, z = vector
    return jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _reflection(normal: Float[Array, "3"]) -> Float[Array, "3 3"]:
    return jnp.eye(3, dtype=normal.dtype) - 2 * jnp.outer(normal, normal)
