"""Every kind of primitive fitted to every column of a membership, and questions asked of the kind that is wanted.

All four kinds are fitted to all columns and one is chosen afterwards: a choice before would trace into the same work,
because a branch under vmap computes all its arms. Cost: a few arrays (c, n, 3) per kind, forward; see losses.
n points, c columns, m points per column. Kinds are positions in primitives/table.KINDS.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jprimfit.primitives.table import KINDS, MODULES
from jprimfit.types import Cone, Cylinder, Plane, Sphere


class Surfaces(NamedTuple):
    """One primitive of every kind for each of c columns; every array has a leading axis c."""

    plane: Plane
    sphere: Sphere
    cylinder: Cylinder
    cone: Cone


def fit_columns(
    points: Float[Array, "n 3"], columns: Float[Array, "n c"], normals: Float[Array, "n 3"]
) -> tuple[Surfaces, Bool[Array, "4 c"]]:
    """The primitive of every kind for the weights in every column, and whether the points determined it (Fit.ok)."""
    weights = columns.T
    fits = [jax.vmap(MODULES[kind].fit, in_axes=(None, 0, None))(points, weights, normals) for kind in KINDS]
    return Surfaces(*[fit.primitive for fit in fits]), jnp.stack([fit.ok for fit in fits])


def of_kind(values: list[Array], kind: Int[Array, " c"]) -> Array:
    """values[kind[j]][j] for every column j; values holds one array (c, ...) per kind."""
    chosen = values[0]
    wanted = kind.reshape(-1, *[1] * (chosen.ndim - 1))
    for number, value in enumerate(values[1:], 1):
        chosen = jnp.where(wanted == number, value, chosen)
    return chosen


def axes(surfaces: Surfaces, kind: Int[Array, " c"]) -> Float[Array, "c 3"]:
    """Plane normal or axis of the primitive of the given kind in every column, unit; zero for spheres."""
    none = jnp.zeros_like(surfaces.plane.normal)
    return of_kind([surfaces.plane.normal, none, surfaces.cylinder.axis, surfaces.cone.axis], kind)


def distances(surfaces: Surfaces, kind: Int[Array, " c"], points: Float[Array, "c m 3"]) -> Float[Array, "c m"]:
    """Unsigned length from the points of every column to its primitive of the given kind."""
    found = [jax.vmap(MODULES[name].distance)(surface, points) for name, surface in zip(KINDS, surfaces, strict=True)]
    return of_kind(found, kind)
