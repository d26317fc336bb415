"""What the four fitters share: work at unit scale, and say honestly whether the points determined the answer.

A fit shifts the points to their weighted mean and divides by their weighted rms distance from it, so that constants
mean the same for a screw and for a ship, then moves the result back. "Determined" is meant statistically: the
standard error that the residuals and the effective number of points leave on a direction or a position is small.
With weights that follow no model (soft memberships) it still tells a shape from a shapeless blob.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST, LinearSolution, effective_count, ridge_solve, weighted_mean

# A direction is determined if the two smallest eigenvalues differ by this part of the largest (a strip 300 times as
# long as wide just passes) and its standard error is below this angle.
MIN_RELATIVE_GAP = 1e-5
MAX_DIRECTION_STD = 0.1
# A position is determined if the normal equations are (linalg.MAX_CONDITION) and its standard error is below this part
# of its distance from the points, or of their size if that is more.
MAX_POSITION_STD = 0.1
SQ_BLUR = 4.0  # (standard deviations)^2 within which a direction from an axis or a center fades out


class Standard(NamedTuple):
    """A cloud at unit scale: points = center + scale * local."""

    local: Float[Array, "n 3"]  # weighted mean 0 and rms distance 1 but for rounding
    weights: Float[Array, " n"]  # sum 1, or all 0
    center: Float[Array, "3"]
    scale: Float[Array, ""]  # 1 where the points are all equal or weigh nothing
    count: Float[Array, ""]  # effective number of points


def standardise(points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Standard:
    """Shift to the weighted mean, divide by the rms distance from it, and divide the weights by their sum.

    center and scale are constants to the derivative: what a fitter makes of the local points and moves back does not
    depend on them, so the derivative through them would be zero at greater cost.
    """
    weights = safe.divide(weights, jnp.sum(weights))
    center = jax.lax.stop_gradient(weighted_mean(points, weights))
    shifted = points - center[None, :]
    size = jax.lax.stop_gradient(safe.sqrt(jnp.sum(weights * jnp.sum(shifted * shifted, axis=1))))
    # Points that agree to rounding have no shape: without this their rounding errors would be blown up to unit scale.
    flat = size <= 4 * jnp.finfo(points.dtype).eps * jnp.max(jnp.abs(center))
    scale = jnp.where(flat, 1, size)
    local = jnp.where(flat, 0, shifted / scale)
    return Standard(local, weights, center, scale, jax.lax.stop_gradient(effective_count(weights)))


def direction_determined(eigenvalues: Float[Array, "3"], count: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether the eigenvector of the smallest of three ascending eigenvalues of a covariance can be trusted.

    Its standard error under independent errors is sqrt(l0 * l1 / count) / (l1 - l0) (Anderson 1963).
    """
    smallest, middle, largest = jnp.maximum(jax.lax.stop_gradient(eigenvalues), 0)
    gap = middle - smallest
    error = safe.sqrt(safe.divide(smallest * middle, count))
    return (gap > MIN_RELATIVE_GAP * largest) & (error < MAX_DIRECTION_STD * gap)


def position_determined(solution: LinearSolution, size: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether a position found by linalg.ridge_solve, relative to the mean of points of that size, can be trusted."""
    distance = safe.norm(jax.lax.stop_gradient(solution.x))
    return solution.ok & (solution.std < MAX_POSITION_STD * jnp.maximum(distance, size))


def fit_round(
    centred: Float[Array, "n d"], weights: Float[Array, " n"]
) -> tuple[Float[Array, " d"], Float[Array, ""], Bool[Array, ""]]:
    """Center, radius and ok of the circle (d = 2) or sphere (d = 3) through points whose weighted mean is 0.

    Minimises sum w (|p - c|^2 - r^2)^2 (Kasa 1976) through its linear form 2 p·c = |p|^2 - mean |p|^2. Where the points
    do not determine the center it is 0, and the radius their rms distance from it.
    """
    sq_distance = jnp.sum(centred * centred, axis=1)
    mean_sq_distance = jnp.sum(weights * sq_distance)
    solution = ridge_solve(2 * centred, sq_distance - mean_sq_distance, weights)
    sq_radius = jnp.sum(weights * jnp.sum((centred - solution.x[None, :]) ** 2, axis=1))
    ok = position_determined(solution, jax.lax.stop_gradient(safe.sqrt(mean_sq_distance)))
    return solution.x, safe.sqrt(sq_radius), ok


def frame_coordinates(points: Float[Array, "n 3"], frame: Float[Array, "3 3"]) -> tuple[Float[Array, " n"], ...]:
    """The coordinates along the three rows of a frame, one array each: what follows runs over whole arrays."""
    return tuple(jnp.matmul(frame, points.T, precision=HIGHEST))


def blurred_reciprocal(offset: Sequence[Float[Array, " n"]], variance: Float[Array, ""]) -> Float[Array, " n"]:
    """1 / |offset|, smooth over the reach of noise of that variance: its derivatives stay bounded at offset 0."""
    floor = jnp.finfo(variance.dtype).tiny ** 0.5
    return jax.lax.rsqrt(sum(coordinate * coordinate for coordinate in offset) + SQ_BLUR * variance + floor)


def steer(axis: Float[Array, "3"], frame: Float[Array, "3 3"], tilt: Float[Array, "2"]) -> Float[Array, "3"]:
    """The unit axis tilted by two small angles towards the first two rows of its frame (linalg.frame_of)."""
    return safe.unit(axis + tilt[0] * frame[0] + tilt[1] * frame[1])
