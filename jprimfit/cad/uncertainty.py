"""How well points determine a primitive: standard errors from the curvature of the sum of squared distances.

The distance of a point changes by minus the speed of the surface along its normal, for every minimal step: tilts and
shifts of an axis about the points' mean, a push, a radius, a half-angle. With these derivatives as the rows of J the
covariance of the estimate is sigma^2 (J^T J)^-1 (C. F. Gauss, 1823), under independent noise of equal sigma. It is
that of `fit_primitive` without its compiled programs, in float64 NumPy. n points, p unknowns of the kind.
"""

import numpy as np
from jaxtyping import Float, Float64

from jprimfit.cad import charts
from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

SMALLEST = 1e-12  # eigenvalue of the scaled J^T J (diagonal 1) below which the points do not determine the primitive


def standard_errors(primitive: Primitive, points: Float[np.ndarray, "n 3"]) -> dict[str, float]:
    """One standard deviation of what a drawing states; inf where the points do not tell it.

    Keys: "direction" (radians, of normal or axis), "offset" of a plane at the middle of its points, "position" (of the
    center, across the axis for a cylinder; of a cone's apex), "radius", "half_angle". The noise is taken from the
    distances of the points; what all of them share (calibration, a wrong kind) does not show.
    """
    points = np.asarray(points, np.float64)
    rows = np.zeros((0, 1)) if len(points) == 0 else _derivatives(primitive, points)
    covariance = _covariance(rows, charts.signed_distances(primitive, points))

    def spread(*which: int) -> float:
        return float(np.sqrt(sum(covariance[i, i] for i in which))) if covariance is not None else float("inf")

    if isinstance(primitive, Plane):
        return {"direction": spread(0, 1), "offset": spread(2)}
    if isinstance(primitive, Sphere):
        return {"position": spread(0, 1, 2), "radius": spread(3)}
    if isinstance(primitive, Cylinder):
        return {"direction": spread(0, 1), "position": spread(2, 3), "radius": spread(4)}
    apex = float("inf")
    if covariance is not None:
        moved = _apex_moves(primitive, points.mean(axis=0))
        apex = float(np.sqrt(max(np.trace(moved @ covariance @ moved.T), 0.0)))
    return {"direction": spread(0, 1), "position": apex, "half_angle": spread(5)}


def _covariance(
    rows: Float64[np.ndarray, "n p"], distances: Float64[np.ndarray, "n"]
) -> Float64[np.ndarray, "p p"] | None:
    """sigma^2 (J^T J)^-1, or None where a step leaves all distances as they are."""
    num_free = len(rows) - rows.shape[1]
    if num_free < 1:
        return None
    normal_matrix = np.einsum("np,nq->pq", rows, rows)
    scale = np.sqrt(np.diag(normal_matrix))
    if not (np.all(np.isfinite(scale)) and np.all(scale > 0)):
        return None
    values, vectors = np.linalg.eigh(normal_matrix / scale[:, None] / scale[None, :])
    if values[0] < SMALLEST:
        return None
    sq_sigma = np.sum(distances**2) / num_free
    return sq_sigma * ((vectors / values[None, :]) @ vectors.T) / scale[:, None] / scale[None, :]


def _derivatives(primitive: Primitive, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n p"]:
    """Speed of the surface along its normal at each point, a column per step; directions u, v as in charts.frame."""
    normals = charts.normals(primitive, points)
    ones = np.ones((len(points), 1))
    if isinstance(primitive, Sphere):
        return np.concatenate([normals, ones], axis=1)
    anchor = points.mean(axis=0)
    if isinstance(primitive, Plane):
        # Towards which the plane tilts is the normal, so points ahead of the anchor see it fall.
        across = charts.frame(np.asarray(primitive.normal))[:2]
        return np.concatenate([-((points - anchor[None, :]) @ across.T), ones], axis=1)
    axes = charts.frame(np.asarray(primitive.axis))
    pivot, height = _pivot(primitive, anchor)
    local = (points - pivot[None, :]) @ axes.T
    u, v, along = normals @ axes[0], normals @ axes[1], normals @ axes[2]
    # A tilt of the axis towards u carries the point (x, y, h) along h u - x axis.
    tilts = [local[:, 2] * u - local[:, 0] * along, local[:, 2] * v - local[:, 1] * along]
    columns = [*tilts, u, v, ones[:, 0]]
    if isinstance(primitive, Cone):
        sine, cosine = np.sin(float(primitive.half_angle)), np.cos(float(primitive.half_angle))
        slant = (local[:, 2] + height) * cosine + np.hypot(local[:, 0], local[:, 1]) * sine
        columns.append(slant - height / cosine)
    return np.stack(columns, axis=1)


def _pivot(primitive: Cylinder | Cone, anchor: Float64[np.ndarray, "3"]) -> tuple[Float64[np.ndarray, "3"], float]:
    """The point of the axis nearest the anchor, and its height above center or apex."""
    axis = charts.frame(np.asarray(primitive.axis))[2]
    origin = np.asarray(primitive.apex if isinstance(primitive, Cone) else primitive.center, np.float64)
    height = float((anchor - origin) @ axis)
    return origin + height * axis, height


def _apex_moves(cone: Cone, anchor: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 6"]:
    """How far each step moves the apex: tilts turn it about the pivot, a push and the half-angle shift it along."""
    axes = charts.frame(np.asarray(cone.axis))
    height = _pivot(cone, anchor)[1]
    sine, cosine = np.sin(float(cone.half_angle)), np.cos(float(cone.half_angle))
    tilts = -height * axes[:2]
    along = np.stack([-axes[2] / sine, height / (sine * cosine) * axes[2]])
    return np.concatenate([tilts, axes[:2], along]).T
