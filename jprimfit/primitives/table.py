"""The four kinds in the order of their type ids, and what asks a primitive of any kind.

Every module of the table offers the same names: KIND, NUM_FREEDOM, STEP_UNITS, fit, signed_distance, distance, normal,
project, sample, transform, discrepancy, retract, canonical, and quadric, instruments, sound for the estimate that noise
does not bias (`estimation`). A further kind is one file and one row here. The kind of a primitive
is part of its type, so the dispatch happens while tracing and costs nothing in compiled code.
"""

from types import ModuleType

import jax.numpy as jnp
from jaxtyping import Array, Float

from jprimfit.geometry.linalg import HIGHEST, frame_of
from jprimfit.primitives import cone, cylinder, plane, sphere
from jprimfit.types import Plane, Primitive, Sphere

KINDS = ("plane", "sphere", "cylinder", "cone")
TYPE_ID = {"plane": 0, "sphere": 1, "cylinder": 2, "cone": 3}
MODULES: dict[str, ModuleType] = {"plane": plane, "sphere": sphere, "cylinder": cylinder, "cone": cone}


def of(primitive_or_kind: Primitive | str) -> ModuleType:
    """The module that knows this kind; ValueError if there is none of that name."""
    kind = primitive_or_kind if isinstance(primitive_or_kind, str) else primitive_or_kind.kind
    if kind not in MODULES:
        raise ValueError(f"unknown kind of primitive {kind!r}: expected one of {', '.join(KINDS)}")
    return MODULES[kind]


def signed_distance(primitive: Primitive, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Length from the surface to each point, positive outside (planes: on the side of the normal)."""
    return of(primitive).signed_distance(primitive, points)


def distance(primitive: Primitive, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Unsigned length from each point to the surface."""
    return of(primitive).distance(primitive, points)


def normal(primitive: Primitive, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Unit gradient of signed_distance at each point."""
    return of(primitive).normal(primitive, points)


def project(primitive: Primitive, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """The nearest point of the surface to each point."""
    return of(primitive).project(primitive, points)


def transform(
    primitive: Primitive, rotation: Float[Array, "3 3"], translation: Float[Array, "3"], scale: Float[Array, ""] | float
) -> Primitive:
    """The primitive after x -> scale * R x + translation, of the same kind and in its gauge."""
    return of(primitive).transform(primitive, rotation, translation, scale)


def in_frame_of(new: Primitive, old: Primitive, covariance: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """The covariance of a step from `old` in the coordinates of one from `new`, hardly another surface.

    The axes are nearly the same line, yet they may point opposite ways, and their frames (linalg.frame_of) jump.
    """
    if isinstance(old, Sphere) or isinstance(new, Sphere):
        return covariance
    first, second = (frame_of(x.normal if isinstance(x, Plane) else x.axis) for x in (old, new))
    across = jnp.matmul(second[:2], first[:2].T, precision=HIGHEST)
    side = jnp.sign(jnp.dot(first[2], second[2], precision=HIGHEST))
    turn = jnp.eye(len(covariance), dtype=covariance.dtype).at[:2, :2].set(side * across)
    turn = turn.at[2, 2].set(side) if isinstance(old, Plane) else turn.at[2:4, 2:4].set(across)
    return jnp.matmul(jnp.matmul(turn, covariance, precision=HIGHEST), turn.T, precision=HIGHEST)
