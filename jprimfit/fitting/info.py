"""What the fit of one segment says of itself: its covariance, and what follows from that for a drawing.

The covariance is found in steps of `retract`, which for a cone move its axis, apex and half-angle. On a patch those are
strongly tied to each other, and an ellipsoid around them is no region of the true cone. A cone is reported by `graph`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jprimfit.fitting import kinds
from jprimfit.primitives import cone
from jprimfit.primitives.table import MODULES
from jprimfit.programs import stored
from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

# Powers of length of the coordinates in which covariances are reported.
STEP_UNITS = {kind: module.STEP_UNITS for kind, module in MODULES.items()} | {"cone": cone.GRAPH_UNITS}


class Info(NamedTuple):
    """How a primitive was found and how well it is known.

    The covariance is that of a minimal step from the answer, taken about the anchor. Of a plane, sphere or cylinder its
    coordinates are those of `retract` in primitives/<kind>.py with the origin at the anchor, u and v the first rows of
    linalg.frame_of(axis); of a cone those of primitives/cone.py's `graph`:
        plane: tilts towards u and v, shift along the normal      sphere: center x, y, z, radius
        cylinder: tilts, shifts of the axis along u and v, radius
        cone: height, two slopes, and tt, gt and gtt derivatives of the surface over the plane that touches it next to
            the anchor, g along the generator, t across it. In them the errors of a sliver are normal, too; how well
            axis, apex and half-angle are known `standard_errors` tells.
    Lengths in the points' unit, angles in radians. What the points cannot tell has a huge variance.
    """

    ok: bool  # the points determined the primitive; where False the values are finite, no more
    sigma: float  # standard deviation of the noise in each coordinate
    rms: float  # root of the weighted mean squared distance
    covariance: Float[np.ndarray, "p p"]  # inf where the method has none (extreme points decide)
    anchor: Float[np.ndarray, "3"]  # weighted mean of the points
    num_iterations: int
    method: str  # "unbiased", "likelihood" (a cone whose whole surface was seen evenly), or the one asked for


def standard_errors(primitive: Primitive, info: Info) -> dict[str, float]:
    """Standard errors of what a drawing states, from the covariance; inf where the method has none.

    Keys: "direction" (radians, of normal or axis), "offset", "position" (of the center, across the axis for a
    cylinder; of a cone's apex), "radius", "half_angle", in the unit of the points.
    """
    covariance = info.covariance

    def spread(*which: int) -> float:
        return float(np.sqrt(max(sum(covariance[i, i] for i in which), 0.0)))

    if isinstance(primitive, Plane):
        return {"direction": spread(0, 1), "offset": spread(2)}
    if isinstance(primitive, Sphere):
        return {"position": spread(0, 1, 2), "radius": spread(3)}
    if isinstance(primitive, Cylinder):
        return {"direction": spread(0, 1), "position": spread(2, 3), "radius": spread(4)}
    if not np.isfinite(covariance).all():
        return dict.fromkeys(("direction", "position", "half_angle"), float("inf"))
    size = float(np.linalg.norm(primitive.apex - info.anchor)) or 1.0  # where it is 1, all is of order 1
    units = size ** -np.asarray(cone.GRAPH_UNITS, float)
    with jax.enable_x64(True):
        by_step, apex_by_step = _of_cone(kinds.move(primitive, -info.anchor / size, 1.0 / size))
    back = np.linalg.pinv(np.asarray(by_step), rcond=1e-15) * units[None, :]
    covariance = semidefinite(back @ covariance @ back.T)
    apex = np.asarray(apex_by_step)
    apex_error = size * float(np.sqrt(np.trace(apex @ covariance @ apex.T)))
    return {"direction": spread(0, 1), "position": apex_error, "half_angle": spread(5)}


def sq_distance(primitive: Primitive, info: Info, other: Primitive) -> float:
    """How far another primitive of the kind is from the answer, by its covariance.

    That of the true surface has a chi-squared distribution with as many degrees as the covariance has rows, so that a
    nominal surface beyond its quantile, 12.6 of a cone for 95 %, is not what was scanned. inf where the covariance is.
    """
    if not np.isfinite(info.covariance).all():
        return float("inf")
    step = step_between(primitive, other, info.anchor)
    if not np.isfinite(step).all():
        return float("inf")
    unit = 1.0 / np.sqrt(np.maximum(np.diagonal(info.covariance), np.finfo(float).tiny))
    correlation = unit[:, None] * info.covariance * unit[None, :]
    return float((unit * step) @ np.linalg.lstsq(correlation, unit * step)[0])


def step_between(start: Primitive, end: Primitive, anchor: Float[np.ndarray, "3"]) -> Float[np.ndarray, " p"]:
    """The step in the coordinates of Info that leads from one primitive to another of its kind."""
    with jax.enable_x64(True):
        start, end = (
            MODULES[one.kind].canonical(jax.tree.map(jnp.asarray, kinds.move(one, -anchor, 1.0)), jnp.zeros(3))
            for one in (start, end)
        )
        return np.asarray(_step(start, _turned_alike(start, end)))


def _turned_alike(start: Primitive, end: Primitive) -> Primitive:
    """The end with its normal or axis on the side of the start's, where its sign says nothing."""
    if not isinstance(end, Plane | Cylinder) or start[0] @ end[0] >= 0:
        return end
    return Plane(-end.normal, -end.offset) if isinstance(end, Plane) else end._replace(axis=-end.axis)


def reported(primitive: Primitive, covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """The covariance of a step of `retract`, at a primitive told from the anchor, in the coordinates of Info."""
    if not isinstance(primitive, Cone) or not np.isfinite(covariance).all():
        return covariance
    by_step = np.asarray(_of_cone(primitive)[0])
    return semidefinite(by_step @ covariance @ by_step.T)


def semidefinite(covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """The same but for rounding, which in what the points hardly tell can leave negative variances."""
    if not np.isfinite(covariance).all():
        return covariance
    spread = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    unit = 1.0 / np.where(spread > 0.0, spread, 1.0)
    correlation = unit[:, None] * (covariance + covariance.T) / 2.0 * unit[None, :]
    values, vectors = np.linalg.eigh(correlation)
    half = spread[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))[None, :]
    return half @ half.T


@stored
def _of_cone(local: Cone) -> tuple[Float[Array, "6 6"], Float[Array, "3 6"]]:
    """Derivatives of the graph and of the apex by a step."""

    def moved(step: Float[Array, "6"]) -> tuple[Float[Array, "6"], Float[Array, "3"]]:
        there = cone.retract(local, step)
        return cone.graph(there, local), there.apex

    return jax.jacfwd(moved)(jnp.zeros(6, local.apex.dtype))


@jax.jit
def _step(start: Any, end: Any) -> Float[Array, " p"]:
    """In the coordinates of Info, from one primitive to another; both told from the anchor."""
    module = MODULES[start.kind]
    if isinstance(start, Cone):
        return cone.graph(end, start) - cone.graph(start, start)

    def difference(step: Float[Array, " p"]) -> Float[Array, " f"]:
        moved = module.canonical(module.retract(start, step), jnp.zeros(3))
        return jnp.concatenate([(a - b).reshape(-1) for a, b in zip(moved, end, strict=True)])

    def improved(_, step: Float[Array, " p"]) -> Float[Array, " p"]:
        return step - jnp.linalg.lstsq(jax.jacfwd(difference)(step), difference(step))[0]

    return jax.lax.fori_loop(0, 12, improved, jnp.zeros(module.NUM_FREEDOM))
