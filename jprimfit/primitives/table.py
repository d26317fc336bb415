"""The four kinds in the order of their type ids, and what asks a primitive of any kind.

Every module of the table offers the same names: KIND, NUM_FREEDOM, STEP_UNITS, fit, signed_distance, distance, normal,
project, sample, transform, discrepancy, retract, canonical, and quadric, instruments, sound for the estimate that noise
does not bias (`estimation`). A further kind is one file and one row here. The kind of a primitive
is part of its type, so the dispatch happens while tracing and costs nothing in compiled code.
"""

from types import ModuleType

from jaxtyping import Array, Float

from jprimfit.primitives import cone, cylinder, plane, sphere
from jprimfit.types import Primitive

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
