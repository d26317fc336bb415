"""The sphere of one segment by the corrected equations of primitives/estimation, written out for the host.

On a sphere all that these equations ask of a point x is its offset u = x - c from the center c and s = |u|^2. With
radius r, variance v, f = s - r^2 and q = 1 / sqrt(s + blur) the instruments are

    k = (q u, 1) / 2r  for center and radius,  f / 4r^2  for v,

and f(X) k = (f - 3 v) k - 2 v u·grad k + v^2 laplace k needs the derivatives q' = -q^3 / 2 and q'' = 3 q^5 / 4 by s.
The same Newton steps and the same sandwich as there, at a fraction of the time. Host code in float64; n points.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jprimfit.fitting.segments import Segment
from jprimfit.primitives import sphere
from jprimfit.primitives.common import SQ_BLUR
from jprimfit.primitives.estimation import CONVERGED, MAX_GROWTH, MAX_ITERATIONS, MAX_STEP, Estimate
from jprimfit.types import Sphere

SAMPLE = 4_096  # points of the first iterations
_EPSILON = float(np.finfo(float).eps)


class _Sums(NamedTuple):
    value: Float[np.ndarray, "5"]  # of the equations of center, radius and variance
    jacobian: Float[np.ndarray, "5 5"]
    covariance: Float[np.ndarray, "5 5"]  # of the value


class _State(NamedTuple):
    unknown: Float[np.ndarray, "5"]  # center, radius, variance
    covariance: Float[np.ndarray, "4 4"]
    moved: float  # what the last iteration may have left, in standard errors
    regular: bool
    iteration: int


def estimate(start: Sphere, points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"]) -> Estimate:
    """What estimation.estimate gives for a sphere, for points at unit scale around their weighted mean."""
    with np.errstate(all="ignore"):  # equations that points leave open overflow; `ok` says so
        return _estimate(start, points, weights / weights.sum())


def _estimate(start: Sphere, points: np.ndarray, weights: np.ndarray) -> Estimate:
    count = 1.0 / float(weights @ weights)
    coordinates = np.ascontiguousarray(points.T)
    first = np.append(np.asarray(start.center, float), float(start.radius))
    offset = coordinates - first[:3, None]
    distance = np.sqrt(np.einsum("cn,cn->n", offset, offset)) - first[3]
    variance = float(weights @ np.square(distance))
    state = _State(np.append(first, variance), np.zeros((4, 4)), np.inf, False, 0)
    stride = len(weights) // SAMPLE
    if stride >= 2:
        found = _solve(state, np.ascontiguousarray(coordinates[:, ::stride]), weights[::stride], count, variance)
        state = found._replace(moved=np.inf) if found.moved < CONVERGED else state
    state = _solve(state, coordinates, weights, count, variance)
    freedom = count - sphere.NUM_FREEDOM - 1.0
    radius = state.unknown[3]
    ok = (
        state.regular
        and np.isfinite(state.unknown).all()
        and state.moved < CONVERGED
        and freedom > 0.0
        and radius > 0.0
    )
    covariance = state.covariance * (count / max(freedom, 1.0))
    found = Sphere(state.unknown[:3], np.float64(radius)) if ok else start
    sigma = np.float64(np.sqrt(max(state.unknown[4], 0.0)))
    covariance = np.where(np.isfinite(covariance), covariance, 0.0)
    return Estimate(found, np.bool_(ok), sigma, covariance, np.int32(state.iteration))  # pyright: ignore[reportArgumentType]


def rms(primitive: Sphere, given: Segment) -> float:
    """Root of the weighted mean squared distance."""
    offset = given.local.T - np.asarray(primitive.center)[:, None]
    distance = np.sqrt(np.einsum("cn,cn->n", offset, offset)) - float(primitive.radius)
    return float(np.sqrt(given.weights @ np.square(distance) / given.weights.sum()))


def _solve(state: _State, coordinates: np.ndarray, weights: np.ndarray, count: float, first_variance: float) -> _State:
    """Newton's method with the limits and the end that estimation._iterate has."""
    while state.iteration < MAX_ITERATIONS and not state.moved < CONVERGED:
        sums = _sums(state.unknown, coordinates, weights, count)
        inverse, regular = _inverse(sums.jacobian)
        change = -inverse @ sums.value
        change = change if np.isfinite(change).all() else np.zeros(5)
        covariance = inverse @ sums.covariance @ inverse.T
        rounding = 100.0 * _EPSILON * np.abs(inverse).sum(axis=1)
        errors = np.sqrt(np.maximum(np.diagonal(covariance), 0.0)) + rounding / CONVERGED
        length = float(np.abs(change[:4]).max())
        moved = float((np.abs(change[:4]) / errors[:4]).max()) * min(1.0, 3.0 * length)
        if abs(change[4]) > 0.1 * state.unknown[4] + (1e3 * _EPSILON) ** 2:
            moved = np.inf
        change = change * min(1.0, MAX_STEP / length if length else 1.0)
        unknown = state.unknown + change
        unknown[4] = np.clip(unknown[4], 0.0, MAX_GROWTH * first_variance)
        state = _State(unknown, covariance[:4, :4], moved, regular, state.iteration + 1)
    return state


def _sums(unknown: np.ndarray, coordinates: np.ndarray, weights: np.ndarray, count: float) -> _Sums:
    """The equations, their derivatives by the unknowns, and the covariance of their value."""
    radius, v = unknown[3], unknown[4]
    half = 0.5 / radius if radius else 0.0
    offset = coordinates - unknown[:3, None]
    s = np.einsum("cn,cn->n", offset, offset)
    f = s - radius * radius
    sq_q = 1.0 / (s + SQ_BLUR * v + np.finfo(float).tiny ** 0.5)
    q, rest = np.sqrt(sq_q), s * sq_q
    used = min(sphere.NUM_FREEDOM / count, 0.9)

    # Of center, radius and variance: the equation as a factor of (u, 1, 1), and its derivative by the variance.
    along, curved = 2.0 * half * q * (1.0 - rest), half * q * sq_q * (3.0 * rest - 5.0)
    center = half * q * (f - 3.0 * v) - v * along + v * v * curved
    level = half * (f - 3.0 * v)
    sq_half = half * half
    noise = sq_half * ((f - 3.0 * v) * f - 4.0 * v * s + 6.0 * v * v) + used * v
    by_center = weights * (2.0 * v * curved - 3.0 * half * q - along)
    by_noise = weights @ (sq_half * (12.0 * v - 3.0 * f - 4.0 * s)) + used * weights.sum()

    scores = np.empty((5, len(s)))
    np.multiply(offset, weights * center, out=scores[:3])
    scores[3], scores[4] = weights * level, weights * noise
    jacobian = np.empty((5, 5))
    jacobian[:3, 4], jacobian[3, 4], jacobian[4, 4] = offset @ by_center, -3.0 * half * weights.sum(), by_noise

    # d/dc of f is -2 u, d/dr of it -2 r; under noise -2 u_j k becomes -2 u_j k + 2 v dk/du_j.
    share = weights * q
    total, slope = float(share.sum()), weights * (q + v * q * sq_q)
    jacobian[:3, :3] = -2.0 * half * ((offset * slope) @ offset.T - v * total * np.eye(3))
    jacobian[:3, 3] = -2.0 * radius * half * (offset @ share)
    mean, level_mean = offset @ weights, float(weights @ f)
    jacobian[3, :3], jacobian[3, 3] = -2.0 * half * mean, -2.0 * radius * half * weights.sum()
    jacobian[4, :3] = sq_half * (-2.0 * (offset @ (weights * f)) + 4.0 * v * mean)
    jacobian[4, 3] = -2.0 * radius * sq_half * level_mean
    return _Sums(scores.sum(axis=1), jacobian, scores @ scores.T)


def _inverse(jacobian: Float[np.ndarray, "5 5"]) -> tuple[Float[np.ndarray, "5 5"], bool]:
    """As estimation._inverse: by singular values at unit scale of rows and columns."""
    finite = bool(np.isfinite(jacobian).all())
    jacobian = jacobian if finite else np.eye(5)
    rows = 1.0 / np.maximum(np.abs(jacobian).max(axis=1), np.finfo(float).tiny)
    columns = 1.0 / np.maximum(np.abs(rows[:, None] * jacobian).max(axis=0), np.finfo(float).tiny)
    left, values, right = np.linalg.svd(rows[:, None] * jacobian * columns[None, :])
    least = 100.0 * _EPSILON * values[0]
    inverse = right.T / np.maximum(values, least)[None, :] @ left.T
    return columns[:, None] * inverse * rows[None, :], finite and bool(values[-1] > least)
