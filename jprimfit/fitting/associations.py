"""The associations of inspection that hang on extreme points: minimum zone, maximum inscribed, minimum circumscribed.

With d the signed distances, positive outside, all are functions of where the surface lies, apart from its last unknown
(offset or radius), which only shifts d:
    minimum zone            least max d - min d      the offset or radius then makes max d = -min d
    maximum inscribed       largest min d            the radius makes it 0
    minimum circumscribed   least max d              the radius makes it 0
A distance changes linearly with a small step, so a step is a linear program over the points that are extreme now; it is
taken if the value gets better, else the trust region shrinks (sequential linear programming).
Names as in ISO 1101 and ISO 14405-1. Host code in float64, at unit scale. n points, p unknowns.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import optimize

from jprimfit.fitting import shapes
from jprimfit.types import Primitive

METHODS = ("minimum-zone", "maximum-inscribed", "minimum-circumscribed")
KINDS = {
    "minimum-zone": ("plane", "sphere", "cylinder"),
    "maximum-inscribed": ("sphere", "cylinder"),
    "minimum-circumscribed": ("sphere", "cylinder"),
}
NUM_EXTREME = 200  # points of either side in a program
MAX_ITERATIONS = 100
CONVERGED = 1e-12  # of the trust region, in radians and sizes of the segment
MAX_RADIUS = 1e3  # in sizes of the segment


class Association(NamedTuple):
    """The associated primitive; ok is False where the steps did not settle or ran away."""

    primitive: Primitive
    ok: bool
    num_iterations: int


def refuse(method: str, kind: str) -> None:
    """A ValueError of one sentence where the method is not defined for the kind."""
    if method in KINDS and kind not in KINDS[method]:
        raise ValueError(
            f'method "{method}" is for {" and ".join(KINDS[method])} only: it is not defined for a {kind}.'
        )


def associate(method: str, start: Primitive, points: Float[np.ndarray, "n 3"]) -> Association:
    """The primitive of a method near a least-squares start; points at unit scale with their mean at the origin.

    A segment seen from one side need not have a largest inscribed or a least circumscribed surface: then ok is False.
    """
    coordinates = np.ascontiguousarray(points.T)
    primitive, region = start, 0.1
    distance, jacobian = shapes.linearised(primitive, coordinates)
    iteration = 0
    while iteration < MAX_ITERATIONS and region >= CONVERGED:
        iteration += 1
        step = _program(method, distance, jacobian, region)
        trial = shapes.canonical(shapes.retract(primitive, np.append(step, 0.0)))
        trial_distance, trial_jacobian = shapes.linearised(trial, coordinates)
        if _value(method, trial_distance) < _value(method, distance):
            region = min(2.0 * max(region, float(np.abs(step).max())), 0.3)
            primitive, distance, jacobian = trial, trial_distance, trial_jacobian
        else:
            region /= 4.0
    last = np.zeros(len(jacobian))
    low, high = float(np.min(distance)), float(np.max(distance))
    last[-1] = {"minimum-zone": (low + high) / 2.0, "maximum-inscribed": low, "minimum-circumscribed": high}[method]
    found = shapes.canonical(shapes.retract(primitive, last))
    bounded = found.kind == "plane" or 0.0 < float(found.radius) < MAX_RADIUS
    return Association(found, bounded and region < CONVERGED, iteration)


def _value(method: str, distance: Any) -> float:
    low, high = float(np.min(distance)), float(np.max(distance))
    return {"minimum-zone": high - low, "maximum-inscribed": -low, "minimum-circumscribed": high}[method]


def _program(
    method: str, distance: Float[np.ndarray, " n"], jacobian: Float[np.ndarray, "p n"], region: float
) -> Float[np.ndarray, "..."]:
    """The step of all unknowns but the last, at most region in each, that is best for the extreme points."""
    order = np.argsort(distance)
    num_extreme = min(NUM_EXTREME, len(order))
    lowest, highest = order[:num_extreme], order[-num_extreme:]
    if method == "minimum-circumscribed":
        lowest = lowest[:0]
    if method == "maximum-inscribed":
        highest = highest[:0]
    # Unknowns: the step, low, high. d + J t >= low, d + J t <= high; least high - low.
    slopes = np.concatenate([-jacobian[:-1, lowest].T, jacobian[:-1, highest].T])
    ends = np.zeros((len(slopes), 2))
    ends[: len(lowest), 0], ends[len(lowest) :, 1] = 1.0, -1.0
    limits = np.concatenate([distance[lowest], -distance[highest]])
    num_steps = slopes.shape[1]
    cost = np.concatenate([np.zeros(num_steps), [-1.0 * (len(lowest) > 0), 1.0 * (len(highest) > 0)]])
    bounds = [(-region, region)] * num_steps + [(None, None) if used else (0.0, 0.0) for used in np.abs(cost[-2:])]
    solved = optimize.linprog(cost, A_ub=np.hstack([slopes, ends]), b_ub=limits, bounds=bounds, method="highs")
    return solved.x[:num_steps] if solved.success else np.zeros(num_steps)
