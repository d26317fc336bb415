"""The plane of one segment in closed form: where a surface is flat, noise biases nothing.

The corrected equations of primitives/estimation are then those of least squares, sum w f k = 0 with f the distance and
k = (x, y, 1) of the coordinates in the plane; the smallest eigenvector of the points' covariance solves them. What is
left of the general path is the sandwich A^-1 B A^-T. Host code in float64; n points, their weighted mean the origin.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jprimfit.geometry import host
from jprimfit.primitives import plane
from jprimfit.types import Plane


class Flat(NamedTuple):
    """A plane and what the points say of its accuracy."""

    primitive: Plane
    ok: bool  # the normal is told from the directions in the plane
    sigma: float  # standard deviation of the noise in each coordinate
    rms: float  # root of the weighted mean squared distance
    covariance: Float[np.ndarray, "3 3"]  # of plane.retract's step


def fit(points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"]) -> Flat:
    """The plane of least sum w f^2 through points of which some have weight."""
    weights = weights / weights.sum()
    count = 1.0 / float(weights @ weights)
    coordinates = np.ascontiguousarray(points.T)
    mean = coordinates @ weights
    square = _products(weights * coordinates, coordinates)
    spread, directions = np.linalg.eigh(square - np.outer(mean, mean))
    normal = directions[:, 0] * np.sign(directions[np.abs(directions[:, 0]).argmax(), 0])
    offset = float(normal @ mean)
    distance = normal @ coordinates - offset
    variance = float(weights @ np.square(distance))
    sigma = np.sqrt(variance / (1.0 - min(plane.NUM_FREEDOM / count, 0.9)))

    # Sums of w k df with df = (x, y, -1) the derivative of f, and of (w f)^2 k k.
    to_plane = host.frame_of(normal)[:2]
    slopes, turn = np.linalg.eigh(_bordered(to_plane, square, mean, 1.0) - np.diag([sigma**2, sigma**2, 0.0]))
    least = 100.0 * np.finfo(float).eps
    inverse = np.array([1.0, 1.0, -1.0])[:, None] * turn / np.maximum(slopes, least) @ turn.T
    share = weights * distance
    moved = share * coordinates
    scores = _bordered(to_plane, _products(moved, moved), moved @ share, float(share @ share))
    freedom = count - plane.NUM_FREEDOM - 1.0
    covariance = inverse @ scores @ inverse.T * (count / max(freedom, 1.0))
    ok = spread[1] - spread[0] > least * spread[2] and freedom > 0.0
    return Flat(Plane(normal, np.float64(offset)), bool(ok), float(sigma), float(np.sqrt(variance)), covariance)


def _products(a: Float[np.ndarray, "3 n"], b: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 3"]:
    """The product a b^T as nine dot products: faster for matrices so long and narrow."""
    return np.array([[row @ column for column in b] for row in a])


def _bordered(to_plane, square, vector, number: float) -> Float[np.ndarray, "3 3"]:
    """The sums of k k out of those of x x, x and 1."""
    across = to_plane @ vector
    return np.block([[to_plane @ square @ to_plane.T, across[:, None]], [across[None, :], np.array([[number]])]])
