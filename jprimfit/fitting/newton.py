"""One Newton step on the corrected equations of primitives/estimation, for the host: its limits, its end, its sandwich.

Shared by what writes those equations out, spheres.py and axial.py. p unknowns of the surface and the variance make q.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jprimfit.primitives.estimation import CONVERGED, MAX_STEP

_EPSILON = float(np.finfo(float).eps)


class Sums(NamedTuple):
    """Weighted sums over points, of mean 0 at the true surface and variance; the last belongs to the variance."""

    value: Float[np.ndarray, " q"]
    jacobian: Float[np.ndarray, "q q"]  # expectation of the derivative by the unknowns
    covariance: Float[np.ndarray, "q q"]  # of the value


class Step(NamedTuple):
    """What to add to the unknowns."""

    change: Float[np.ndarray, " q"]
    covariance: Float[np.ndarray, "p p"]  # of the unknowns of the surface
    moved: float  # what the step may have left, in standard errors; inf while the variance is unsettled
    regular: bool


def step(sums: Sums, variance: float) -> Step:
    """The step that estimation takes from these sums, no longer than MAX_STEP."""
    inverted, regular = _inverse(sums.jacobian)
    change = -inverted @ sums.value
    change = change if np.isfinite(change).all() else np.zeros(len(change))
    covariance = inverted @ sums.covariance @ inverted.T
    rounding = 100.0 * _EPSILON * np.abs(inverted).sum(axis=1)
    errors = np.sqrt(np.maximum(np.diagonal(covariance), 0.0)) + rounding / CONVERGED
    length = float(np.abs(change[:-1]).max())
    moved = float((np.abs(change[:-1]) / errors[:-1]).max()) * min(1.0, 3.0 * length)
    if abs(change[-1]) > 0.1 * variance + (1e3 * _EPSILON) ** 2:
        moved = np.inf
    change = change * min(1.0, MAX_STEP / length if length else 1.0)
    return Step(change, covariance[:-1, :-1], moved, regular)


def _inverse(jacobian: Float[np.ndarray, "q q"]) -> tuple[Float[np.ndarray, "q q"], bool]:
    """As estimation._inverse: by singular values at unit scale of rows and columns."""
    finite = bool(np.isfinite(jacobian).all())
    jacobian = jacobian if finite else np.eye(len(jacobian))
    rows = 1.0 / np.maximum(np.abs(jacobian).max(axis=1), np.finfo(float).tiny)
    columns = 1.0 / np.maximum(np.abs(rows[:, None] * jacobian).max(axis=0), np.finfo(float).tiny)
    left, values, right = np.linalg.svd(rows[:, None] * jacobian * columns[None, :])
    least = 100.0 * _EPSILON * values[0]
    inverse = right.T / np.maximum(values, least)[None, :] @ left.T
    return columns[:, None] * inverse * rows[None, :], finite and bool(values[-1] > least)
