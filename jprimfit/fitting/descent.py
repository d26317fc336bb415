"""Levenberg-Marquardt on the distances of one surface, on the host: solvers/least_squares.py in NumPy.

The steps, their damping and its factors are the same. They end where one lowers the cost by less than shows. Points at
unit scale, all of equal weight.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import lapack

from jprimfit.fitting import shapes
from jprimfit.types import Primitive

SLOW = 0.1  # of the cost: a step that gains less, far from where it would have to lead, is the last
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-9, 1e9
GAIN = 1e-5  # of the cost: a step that gains less is the last; with 1e-3 what is grown under noise is worse
ROUNDING = 1e-12  # an rms distance that is zero
RIDGE = 10.0 * np.finfo(float).eps


class Minimum(NamedTuple):
    """Where the steps ended."""

    primitive: Primitive  # in its gauge about the origin
    rms: float  # of the distances
    ok: bool  # all of it is finite


def minimise(
    start: Primitive, coordinates: Float[np.ndarray, "3 n"], *, num_steps: int, worst: float = np.inf
) -> Minimum:
    """Lowers the squared distances of n points (3, n) to a surface by at most num_steps steps.

    worst: rms distance beyond which the answer is of no use, so that slow progress there is given up.
    """
    with np.errstate(all="ignore"):  # a step that leads nowhere overflows, and is not taken
        return _minimise(start, coordinates, num_steps, worst)


def _minimise(primitive: Primitive, coordinates: np.ndarray, num_steps: int, worst: float) -> Minimum:
    count, damping = coordinates.shape[1], FIRST_DAMPING
    linear = shapes.linearised(primitive, coordinates)
    cost, gradient, hessian = _system(linear)
    for _ in range(num_steps):
        step = -_solved(gradient, hessian, damping)
        trial = shapes.retract(primitive, step)
        linear = shapes.linearised(trial, coordinates)
        next_cost, next_gradient, next_hessian = _system(linear)
        better = next_cost < cost and math.isfinite(next_hessian.sum())
        gain = cost - next_cost if better else -0.5 * float(gradient @ step)
        least = SLOW if min(cost, next_cost) > 0.5 * count * worst**2 else GAIN
        is_last = (damping <= FIRST_DAMPING or not better) and gain <= least * cost
        if better:
            primitive, cost, gradient, hessian = trial, next_cost, next_gradient, next_hessian
        damping = min(max(damping * (0.1 if better else 10.0), MIN_DAMPING), MAX_DAMPING)
        if is_last or cost <= 0.5 * count * ROUNDING**2:
            break
    found = shapes.canonical(primitive)
    ok = np.isfinite(cost) and all(np.isfinite(field).all() for field in found)
    return Minimum(found, float(np.sqrt(2.0 * cost / count)), bool(ok))


def _system(linear: shapes.Linear) -> tuple[float, np.ndarray, np.ndarray]:
    """Half the sum of squares, its gradient, and J^T J."""
    distance, jacobian = linear
    return 0.5 * float(distance @ distance), jacobian @ distance, jacobian @ jacobian.T


def _solved(gradient: np.ndarray, hessian: np.ndarray, damping: float) -> np.ndarray:
    """(H + damping diag H)^-1 g by a Cholesky factor at a diagonal of 1; 0 where there is none."""
    diagonal = np.sqrt(hessian.diagonal())
    shrink = 1.0 / np.where(diagonal > 0.0, diagonal, np.inf)
    scaled = shrink[:, None] * hessian * shrink
    scaled.flat[:: len(scaled) + 1] += damping + RIDGE
    _, step, failed = lapack.dposv(scaled, shrink * gradient)  # pyright: ignore[reportAttributeAccessIssue]
    step = shrink * step
    return np.zeros_like(gradient) if failed or not math.isfinite(step.sum()) else step
