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

from jprimfit.fitting import newton
from jprimfit.fitting.segments import Segment
from jprimfit.primitives import sphere
from jprimfit.primitives.common import SQ_BLUR
from jprimfit.primitives.estimation import CONVERGED, MAX_GROWTH, MAX_ITERATIONS, Estimate
from jprimfit.types import Sphere

SAMPLE = 4_096  # points of the first iterations
BLOCK = 8_192  # points summed at a time: their intermediate values stay in the processor's cache


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
    variance = _mean_square(first, coordinates, weights)
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


def with_doubt(found: Estimate, points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"]) -> Estimate:
    """The estimate with a covariance that makes up for being known from these points only (newton.py)."""
    weights = weights / weights.sum()
    count = 1.0 / float(weights @ weights)
    unknown = np.array([*found.primitive[0], found.primitive[1], float(found.sigma) ** 2], float)

    def sums_of(some: slice) -> newton.Sums:
        return _sums(unknown, np.ascontiguousarray(points[some].T), weights[some], count)

    return newton.with_doubt(found, sums_of, len(points))


def rms(primitive: Sphere, given: Segment) -> float:
    """Root of the weighted mean squared distance."""
    unknown = np.append(np.asarray(primitive.center, float), float(primitive.radius))
    return float(np.sqrt(_mean_square(unknown, given.local.T, given.weights / given.weights.sum())))


def _blocks(count: int) -> list[slice]:
    return [slice(start, start + BLOCK) for start in range(0, count, BLOCK)]


def _mean_square(unknown: np.ndarray, coordinates: np.ndarray, weights: np.ndarray) -> float:
    """The mean squared distance from the sphere."""
    total = 0.0
    for block in _blocks(len(weights)):
        offset = coordinates[:, block] - unknown[:3, None]
        distance = np.sqrt(np.einsum("cn,cn->n", offset, offset)) - unknown[3]
        total += float(weights[block] @ np.square(distance))
    return total


def _solve(state: _State, coordinates: np.ndarray, weights: np.ndarray, count: float, first_variance: float) -> _State:
    """Newton's method with the limits and the end that estimation._iterate has."""
    while state.iteration < MAX_ITERATIONS and not state.moved < CONVERGED:
        step = newton.step(_sums(state.unknown, coordinates, weights, count), state.unknown[4])
        unknown = state.unknown + step.change
        unknown[4] = np.clip(unknown[4], 0.0, MAX_GROWTH * first_variance)
        state = _State(unknown, step.covariance, step.moved, step.regular, state.iteration + 1)
    return state


def _sums(unknown: np.ndarray, coordinates: np.ndarray, weights: np.ndarray, count: float) -> newton.Sums:
    """The equations, their derivatives by the unknowns, and the covariance of their value; a block of points a time."""
    sums = (_block_sums(unknown, coordinates[:, block], weights[block], count) for block in _blocks(len(weights)))
    return newton.Sums(*(np.sum(terms, axis=0) for terms in zip(*sums, strict=True)))


def _block_sums(unknown: np.ndarray, coordinates: np.ndarray, weights: np.ndarray, count: float) -> newton.Sums:
    radius, v = unknown[3], unknown[4]
    half = 0.5 / radius if radius else 0.0
    blur = SQ_BLUR * v + np.finfo(float).tiny ** 0.5
    offset = coordinates - unknown[:3, None]
    f = np.einsum("cn,cn->n", offset, offset)
    sq_q = 1.0 / (f + blur)
    f -= radius * radius

    # Since s q^2 = 1 - blur q^2, every equation is a combination of w q (1, q^2, q^4, f) and w (1, f, f^2).
    by_q, by_w = np.empty((4, len(f))), np.empty((3, len(f)))
    np.multiply(weights, np.sqrt(sq_q), out=by_q[0])
    np.multiply(by_q[0], sq_q, out=by_q[1])
    np.multiply(by_q[1], sq_q, out=by_q[2])
    np.multiply(by_q[0], f, out=by_q[3])
    by_w[0] = weights
    np.multiply(weights, f, out=by_w[1])
    np.multiply(by_w[1], f, out=by_w[2])
    used = min(sphere.NUM_FREEDOM / count, 0.9)
    center = half * np.array([-3.0 * v, -2.0 * v * (blur + v), -3.0 * blur * v * v, 1.0])
    center_by_v = half * np.array([-3.0, -4.0 * v - 2.0 * blur, -6.0 * blur * v, 0.0])
    level = half * np.array([-3.0 * v, 1.0, 0.0])
    sq_half, square = half * half, radius * radius
    noise = sq_half * np.array([v * (6.0 * v - 4.0 * square), -7.0 * v, 1.0]) + [used * v, 0.0, 0.0]
    noise_by_v = sq_half * np.array([12.0 * v - 4.0 * square, -7.0, 0.0]) + [used, 0.0, 0.0]

    scores = np.empty((5, len(f)))
    np.multiply(offset, center @ by_q, out=scores[:3])
    np.matmul(np.stack([level, noise]), by_w, out=scores[3:])
    sum_w, sum_f, _ = by_w.sum(axis=1)
    moment_q, moment_w, moment_f = offset @ by_q.T, offset @ weights, offset @ by_w[1]
    jacobian = np.empty((5, 5))
    jacobian[:3, 4], jacobian[3, 4] = moment_q @ center_by_v, -3.0 * half * sum_w
    jacobian[4, 4] = noise_by_v[0] * sum_w + noise_by_v[1] * sum_f
    # d/dc of f is -2 u, d/dr of it -2 r; under noise -2 u_j k becomes -2 u_j k + 2 v dk/du_j.
    slope = np.array([1.0, v]) @ by_q[:2]
    jacobian[:3, :3] = -2.0 * half * ((offset * slope) @ offset.T - v * by_q[0].sum() * np.eye(3))
    jacobian[:3, 3] = -2.0 * radius * half * moment_q[:, 0]
    jacobian[3, :3], jacobian[3, 3] = -2.0 * half * moment_w, -2.0 * radius * half * sum_w
    jacobian[4, :3] = sq_half * (-2.0 * moment_f + 4.0 * v * moment_w)
    jacobian[4, 3] = -2.0 * radius * sq_half * sum_f
    return newton.Sums(scores.sum(axis=1), jacobian, scores @ scores.T)
