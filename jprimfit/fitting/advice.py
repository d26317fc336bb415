"""What geometry takes from a network's answer: patches to grow from, kinds to expect, normals where noise hides them.

The network proposes and geometry decides. A segment's heart are the points whose membership is clear; the rest, beside
edges, is where networks err. Letters: m points that the network saw among n points, s segments.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

# Membership from which a point belongs to the heart of its segment; chosen together with clustering.SQ_BANDWIDTH.
CLEAR = 0.6
MIN_POINTS = 8  # of a heart, among those that the network saw
LEAST_PROBABILITY = 0.02  # of a kind: networks are surer than they should be


class Advice(NamedTuple):
    """What a network says of n points."""

    patches: tuple[Int[np.ndarray, "_"], ...]  # rows of points in the heart of each segment
    log_types: Float[np.ndarray, "n 4"]  # log-probability of each kind, in the order of primitives/table.KINDS
    normals: Float[np.ndarray, "n 3"]  # unit, of either sign


def advice(
    points: Float[np.ndarray, "n 3"],
    rows: Int[np.ndarray, "m"],
    membership: Float[np.ndarray, "m s"],
    type_probability: Float[np.ndarray, "m 4"],
    normals: Float[np.ndarray, "m 3"],
) -> Advice:
    """The advice in an answer for some rows of the points; the others take that of the nearest among them."""
    nearest = KDTree(points[rows]).query(points)[1]
    label = np.where(membership.max(axis=1) >= CLEAR, membership.argmax(axis=1), -1)
    kept = [number for number in range(membership.shape[1]) if np.sum(label == number) >= MIN_POINTS]
    spread = label[nearest]
    return Advice(
        tuple(np.flatnonzero(spread == number) for number in kept),
        np.log(np.maximum(type_probability, LEAST_PROBABILITY))[nearest].astype(np.float64),
        normals[nearest].astype(np.float64),
    )
