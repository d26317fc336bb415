"""What a drawing says of each primitive of a scene, measured from its points and its trimmed surface.

Extents are those of extents.py, hole or boss of sides.py, uncertainties of uncertainty.py. A warning names what makes
an answer thin: few points, a short arc, a cone that is nearly a plane or a cylinder, a radius or axis hardly known.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jprimfit.cad import charts, extents, sides
from jprimfit.cad.patches import Patch
from jprimfit.cad.uncertainty import standard_errors
from jprimfit.types import Cone, Cylinder, Feature, Plane, Primitive, Sphere

FEW_POINTS = 50
SHORT_ARC = np.radians(60.0)
SMALL_CAP = 0.1  # of a whole sphere
LARGE_SHARE = 0.01  # standard error of a radius, in radii
LARGE_ANGLE = np.radians(1.0)  # standard error of a direction or half-angle
STEEP, SHALLOW = np.radians(3.0), np.radians(85.0)


def features(
    primitives: Sequence[Primitive],
    points: Float[np.ndarray, "n 3"],
    rows_of: Sequence[Int[np.ndarray, "_"]],
    patches: Sequence[Patch],
) -> tuple[Feature, ...]:
    """The feature of each primitive; patches[i] is primitives[i] trimmed to points[rows_of[i]]."""
    outward = sides.outward(patches)
    found = []
    for primitive, rows, patch, sign in zip(primitives, rows_of, patches, outward.tolist(), strict=True):
        is_hole = None if isinstance(primitive, Plane) or sign == 0 else sign < 0
        found.append(feature(primitive, points[rows], patch)._replace(is_hole=is_hole))
    return tuple(found)


def feature(primitive: Primitive, points: Float[np.ndarray, "n 3"], patch: Patch) -> Feature:
    """The feature of one primitive, but whether it is a hole."""
    points = np.asarray(points, np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    if not _is_sound(primitive):
        nan = float("nan")
        return Feature(len(points), nan, nan, np.full(3, nan), 0.0, warning="parameters are no surface")
    distance = charts.signed_distances(primitive, points)
    rms = float(np.sqrt(np.mean(distance**2))) if len(points) else float("nan")
    measured = Feature(
        num_points=len(points),
        rms=rms,
        largest_deviation=float(distance[np.argmax(np.abs(distance))]) if len(points) else float("nan"),
        standard_errors=standard_errors(primitive, points),
        **extents.extents(primitive, points, patch, blur=rms if len(points) else 0.0),
    )
    return measured._replace(warning="; ".join(_doubts(primitive, measured, len(patch.faces) == 0)))


def _is_sound(primitive: Primitive) -> bool:
    """Whether the parameters are finite, the direction has a length and the size is positive."""
    fields = {name: np.asarray(value, np.float64) for name, value in primitive._asdict().items()}
    finite = all(np.isfinite(value).all() for value in fields.values())
    directed = all(np.any(fields[name] != 0) for name in ("normal", "axis") if name in fields)
    return finite and directed and all(fields[name] > 0 for name in ("radius", "half_angle") if name in fields)


def _doubts(primitive: Primitive, found: Feature, is_empty: bool) -> list[str]:
    """Why not to rely on a feature, most telling first."""
    errors = found.standard_errors or {}
    doubts = []
    if is_empty:
        doubts.append("too few points for a surface")
    elif found.num_points < FEW_POINTS:
        doubts.append(f"only {found.num_points} points")
    if isinstance(primitive, Cone) and not STEEP < float(primitive.half_angle) < SHALLOW:
        doubts.append("nearly a cylinder" if float(primitive.half_angle) <= STEEP else "nearly a plane")
    if found.arc is not None and found.arc < SHORT_ARC:
        doubts.append(f"only {np.degrees(found.arc):.0f} deg of the turn seen")
    if found.solid_angle is not None and found.solid_angle < SMALL_CAP * 4 * np.pi:
        doubts.append(f"only {100 * found.solid_angle / (4 * np.pi):.0f} % of the sphere seen")
    if isinstance(primitive, Sphere | Cylinder) and errors["radius"] > LARGE_SHARE * float(primitive.radius):
        doubts.append("radius hardly known")
    if errors.get("half_angle", 0.0) > LARGE_ANGLE:
        doubts.append("half-angle hardly known")
    if errors.get("direction", 0.0) > LARGE_ANGLE:
        doubts.append("normal hardly known" if isinstance(primitive, Plane) else "axis hardly known")
    return doubts
