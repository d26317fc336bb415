"""Outlines of flat patches as few straight pieces or as circles: what a CAD program wants to see of a boundary.

A loop is a closed polygon (k, 2) without its first point repeated; counter-clockwise loops have positive area and are
outer boundaries, clockwise ones are holes. Polygons are thinned by the rule of D. Douglas and T. Peucker (1973).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

MIN_CIRCLE_POINTS = 8
MIN_CIRCLE_RADIUS = 5.0  # in tolerances: a smaller circle cannot be told from a square


class Circle(NamedTuple):
    """A circle in the plane of the loop."""

    center: Float64[np.ndarray, "2"]
    radius: float


def signed_area(loop: Float[np.ndarray, "k 2"]) -> float:
    """Area inside the loop, negative where it turns clockwise."""
    # Relative to one corner: large coordinates would swallow the digits of a small area.
    x, y = (loop - loop[:1]).T
    return float(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def simplified(loop: Float[np.ndarray, "k 2"], *, tolerance: float) -> Float[np.ndarray, "j 2"]:
    """The fewest corners of the loop (by repeated halving) that stay within `tolerance` of all others."""
    # The corner farthest from the middle, and the one farthest from it, certainly stay.
    first = int(np.argmax(np.sum((loop - loop.mean(axis=0)[None, :]) ** 2, axis=1)))
    loop = np.roll(loop, -first, axis=0)
    second = int(np.argmax(np.sum((loop - loop[:1]) ** 2, axis=1)))
    closed = np.concatenate([loop, loop[:1]])
    keep = np.zeros(len(closed), bool)
    keep[[0, second, -1]] = True
    _keep_corners(closed, keep, [(0, second), (second, len(closed) - 1)], tolerance)
    return loop[keep[:-1]]


def circle(loop: Float[np.ndarray, "k 2"], *, tolerance: float) -> Circle | None:
    """The circle through all corners of the loop, to within `tolerance`; None where the loop is none.

    Algebraic least squares about the mean: |x|^2 = 2 c·x + d (I. Kåsa, 1976), good enough on a full turn.
    """
    if len(loop) < MIN_CIRCLE_POINTS:
        return None
    mean = loop.mean(axis=0)
    centred = loop - mean[None, :]
    rows = np.concatenate([2 * centred, np.ones((len(loop), 1))], axis=1)
    (x, y, rest), *_ = np.linalg.lstsq(rows, np.sum(centred**2, axis=1), rcond=None)
    radius = float(np.sqrt(max(rest + x * x + y * y, 0.0)))
    error = np.abs(np.hypot(centred[:, 0] - x, centred[:, 1] - y) - radius).max()
    if error > tolerance or radius < MIN_CIRCLE_RADIUS * tolerance:
        return None
    return Circle(mean + np.array([x, y]), radius)


def _keep_corners(
    closed: Float[np.ndarray, "k 2"], keep: Bool[np.ndarray, "k"], stretches: list[tuple[int, int]], tolerance: float
) -> None:
    """Marks in `keep` the farthest corner of every stretch that strays from its chord, again and again."""
    while stretches:
        start, end = stretches.pop()
        if end - start < 2:
            continue
        chord, offset = closed[end] - closed[start], closed[start + 1 : end] - closed[start][None, :]
        length = np.sqrt(chord @ chord)
        share = np.clip(offset @ chord / max(length, 1e-300) ** 2, 0.0, 1.0) if length > 0 else np.zeros(len(offset))
        distance = np.sqrt(np.sum((offset - share[:, None] * chord[None, :]) ** 2, axis=1))
        farthest = int(np.argmax(distance))
        if distance[farthest] > tolerance:
            middle = start + 1 + farthest
            keep[middle] = True
            stretches += [(start, middle), (middle, end)]
