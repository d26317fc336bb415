"""One Newton step on the corrected equations of primitives/estimation, for the host: its limits, its end, its sandwich.

Shared by what writes those equations out, spheres.py and axial.py. p unknowns of the surface and the variance make q.

The sandwich A^-1 B A^-T holds for many points. Of few, and where a few of many count most, as those next to the apex of
a cone, A and B are themselves known badly, and regions around the answer come out too small. How badly, leaving out a
part of the points at a time tells (the jackknife; Tukey 1958): let L L^T be the covariance, L (1 + D) L^T the one
without a part. The inverse of a covariance that varies like this is too large in the mean, by the sum of all D D to
second order, and L (sum of D D) L^T is what is added.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jprimfit.primitives.estimation import CONVERGED, MAX_STEP, Estimate

PARTS = 50  # that are left out in turn
MANY = 20_000  # points from which on what that adds does not show

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


def with_doubt(found: Estimate, sums_of: Callable[[slice], Sums], num_points: int) -> Estimate:
    """The estimate with what its covariance lacks for being known from these points only.

    sums_of: the sums at the solution over some of the points.
    """
    if not found.ok or num_points >= MANY:
        return found
    with np.errstate(all="ignore"):
        added = _doubt([sums_of(slice(first, None, PARTS)) for first in range(min(PARTS, num_points))])
    return found._replace(covariance=found.covariance + added) if np.isfinite(added).all() else found


def _doubt(sums: Sequence[Sums]) -> Float[np.ndarray, "p p"]:
    """The sum of L D D L^T."""
    jacobian = np.sum([part.jacobian for part in sums], axis=0)
    scores = np.sum([part.covariance for part in sums], axis=0)
    whole = _sandwich(jacobian, scores)
    spread = np.sqrt(np.maximum(np.diagonal(whole), np.finfo(float).tiny))
    correlation = whole / spread[:, None] / spread
    if not np.isfinite(correlation).all():
        return whole
    values, vectors = np.linalg.eigh(correlation)
    root = vectors * np.sqrt(np.maximum(values, 100.0 * _EPSILON))
    back = np.linalg.inv(root)
    left = 1.0 - 1.0 / len(sums)
    added = np.zeros_like(whole)
    for part in sums:
        without = left * _sandwich(jacobian - part.jacobian, scores - part.covariance)
        change = back @ ((without - whole) / spread[:, None] / spread) @ back.T
        added += left * change @ change
    return spread[:, None] * (root @ added @ root.T) * spread


def _sandwich(jacobian: Float[np.ndarray, "q q"], scores: Float[np.ndarray, "q q"]) -> Float[np.ndarray, "p p"]:
    inverted, _ = _inverse(jacobian)
    return (inverted @ scores @ inverted.T)[:-1, :-1]


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
