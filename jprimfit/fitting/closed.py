"""The closed-form fits of primitives/ on the host: the paper's solvers for rows of a cloud, all of equal weight.

Each returns a primitive, always, and whether the points determine it, judged as primitives/common.py does. Points are
at unit scale: their mean is the origin and their rms distance from it 1; coordinates and normals are (3, n), the
normals of any sign. NumPy in float64.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jprimfit.geometry import host
from jprimfit.geometry.linalg import MAX_CONDITION
from jprimfit.primitives.common import MAX_DIRECTION_STD, MAX_POSITION_STD, MIN_RELATIVE_GAP
from jprimfit.primitives.cone import MAX_HALF_ANGLE, MIN_HALF_ANGLE, MIN_ONE_SIDED
from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere


class Start(NamedTuple):
    """A primitive from which distances are then minimised."""

    primitive: Primitive
    ok: bool  # determined by the points


class _Solution(NamedTuple):
    """The x of least sum (rows·x - values)^2; 0 where the rows do not determine it."""

    x: Float[np.ndarray, " d"]
    ok: bool
    std: float  # standard error along the worst direction


def fit(kind: str, coordinates: Float[np.ndarray, "3 n"], normals: Float[np.ndarray, "3 n"]) -> Start:
    """The primitive of one kind."""
    if kind == "plane":
        return _plane(coordinates)
    if kind == "sphere":
        center, radius, ok = _round(coordinates)
        return Start(Sphere(center, radius), ok)
    return _cylinder(coordinates, normals) if kind == "cylinder" else _cone(coordinates, normals)


def _plane(coordinates: np.ndarray) -> Start:
    """primitives/plane.fit: the direction of least extent."""
    normal, is_told = _smallest(coordinates @ coordinates.T / coordinates.shape[1], coordinates.shape[1])
    return Start(Plane(normal, np.float64(0.0)), is_told)


def _cylinder(coordinates: np.ndarray, normals: np.ndarray) -> Start:
    """primitives/cylinder.fit: the direction most nearly perpendicular to all normals, and the circle across it."""
    axis, is_told = _smallest(normals @ normals.T / normals.shape[1], normals.shape[1])
    across = host.frame_of(axis)[:2]
    center, radius, ok = _round(across @ coordinates)
    return Start(Cylinder(axis, center @ across, radius), is_told and ok)


def _cone(coordinates: np.ndarray, normals: np.ndarray) -> Start:
    """primitives/cone.fit: the point where tangent planes meet, the direction that normals share, the mean angle."""
    count = coordinates.shape[1]
    tangent = _solve(normals, np.einsum("cn,cn->n", normals, coordinates))
    rays = coordinates - tangent.x[:, None]
    rays /= np.maximum(np.sqrt(np.einsum("cn,cn->n", rays, rays)), np.finfo(float).tiny)
    inwards = rays.mean(axis=1) @ normals > 0.0
    outwards = np.where(inwards, -normals, normals)
    outwards -= outwards.mean(axis=1)[:, None]
    axis, is_told = _smallest(outwards @ outwards.T / count, count)
    cosines = axis @ rays
    sines = np.sqrt(np.maximum(1.0 - cosines * cosines, 0.0))
    half_angle = float(np.arctan2(sines, np.abs(cosines)).mean())
    one_sided = abs(cosines.sum()) > MIN_ONE_SIDED * np.abs(cosines).sum()
    ok = tangent.ok and tangent.std < MAX_POSITION_STD * max(float(np.linalg.norm(tangent.x)), 1.0) and is_told
    ok = ok and bool(one_sided) and MIN_HALF_ANGLE < half_angle < MAX_HALF_ANGLE
    angle = np.float64(min(max(half_angle, MIN_HALF_ANGLE), MAX_HALF_ANGLE))
    return Start(Cone(-axis if cosines.sum() < 0.0 else axis, tangent.x, angle), ok)


def _round(coordinates: Float[np.ndarray, "d n"]) -> tuple[Float[np.ndarray, " d"], np.float64, bool]:
    """primitives/common.fit_round: center, radius and ok of the circle or sphere through points of mean 0."""
    square = np.einsum("dn,dn->n", coordinates, coordinates)
    mean = float(square.mean())
    found = _solve(2.0 * coordinates, square - mean)
    radius = np.sqrt(mean + found.x @ found.x)
    ok = found.ok and found.std < MAX_POSITION_STD * max(float(np.linalg.norm(found.x)), math.sqrt(mean))
    return found.x, np.float64(radius), ok


def _smallest(matrix: Float[np.ndarray, "3 3"], count: int) -> tuple[Float[np.ndarray, "3"], bool]:
    """The eigenvector of the smallest eigenvalue, oriented, and common.direction_determined."""
    values, vectors = np.linalg.eigh(matrix)
    smallest, middle, largest = np.maximum(values, 0.0).tolist()
    gap = middle - smallest
    is_told = gap > MIN_RELATIVE_GAP * largest and math.sqrt(smallest * middle / count) < MAX_DIRECTION_STD * gap
    vector = vectors[:, 0]
    return host.orientation(vector) * vector, is_told


def _solve(rows: Float[np.ndarray, "d n"], values: Float[np.ndarray, " n"]) -> _Solution:
    """linalg.ridge_solve; in float64 no ridge is needed below its MAX_CONDITION."""
    matrix, vector = rows @ rows.T, rows @ values
    eigenvalues = np.linalg.eigvalsh(matrix)
    if not eigenvalues[0] * MAX_CONDITION > eigenvalues[-1]:
        return _Solution(np.zeros(len(rows)), False, math.inf)
    x = np.linalg.solve(matrix, vector)
    sq_residual = float(np.square(x @ rows - values).mean())
    return _Solution(x, True, math.sqrt(sq_residual / eigenvalues[0]))
