"""Maximum likelihood for a cone that was seen all round and evenly by area.

Near the apex it beats any estimate that asks nothing of the density; so it is used where the points bear that density
out, and nowhere else. A point has the radius rho from the axis and the height z over the apex. With slant s between s0
and s1, r = s sin and h = s cos of the half-angle its density is, up to a constant, the integral of
    2 pi r I0(rho r / sigma^2) exp(-(rho^2 + r^2 + (z - h)^2) / 2 sigma^2) ds / (area sigma^3),
here by Gauss-Legendre quadrature on k nodes. Fisher scoring over nine unknowns: the six of Cone.retract, sigma, s0, s1.
Host code in float64; the origin is the mean of the points, n of them.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import special, stats

from jprimfit.types import Cone

MIN_POINTS = 500
MAX_NODES = 72  # more are needed only where the noise is so small that the density adds nothing
NODES_PER_SIGMA = 1.5
NUM_TURNS, NUM_HEIGHTS = 12, 6  # cells of the test of the density
MIN_PROBABILITY = 1e-3  # of counts as uneven as those seen, were the density right
MAX_ITERATIONS = 15
SAMPLE = 8_192  # points of the first iterations
CONVERGED = 0.1  # a step in standard errors; the next one is a small part of it
MAX_LAST = 10.0  # the same, of the only step on all points
CHUNK = 1_024  # points at a time: their nodes stay in the cache
REACH = 6.5  # standard deviations from the slant of a point beyond which nodes have no share


class FullCone(NamedTuple):
    """The most likely cone, its noise, and its covariance in the coordinates of Cone.retract, but for the frame."""

    cone: Cone
    sigma: float
    covariance: Float[np.ndarray, "6 6"]
    frame: Float[np.ndarray, "3 3"]  # rows u, v, axis: the covariance's tilts and shifts are along u and v


class _Model(NamedTuple):
    frame: Float[np.ndarray, "3 3"]  # rows u, v, axis
    anchor: Float[np.ndarray, "3"]  # the axis point nearest the origin
    height: float  # of the anchor over the apex
    half_angle: float
    sigma: float
    ends: tuple[float, float]  # s0, s1


def fit(
    start: Cone, frame: Float[np.ndarray, "3 3"], sigma: float, points: Float[np.ndarray, "n 3"]
) -> FullCone | None:
    """The most likely cone near an unbiased start; None where the points do not cover its nappe evenly, or need not.

    frame: rows are two directions across the start's axis, and it.
    """
    model = _first_model(start, frame, sigma, points)
    if model is None or len(points) < MIN_POINTS or _num_nodes(model) > MAX_NODES or not _is_round(model, points):
        return None
    x, y, z = _local(model, points)
    points = points[np.argsort(np.hypot(x, y) * math.sin(model.half_angle) + z * math.cos(model.half_angle))]
    # Some points settle it but for the last digits, which one step on all of them adds.
    settled = _scored(model, points[:: max(1, len(points) // SAMPLE)], max_iterations=MAX_ITERATIONS)
    solved = settled and _scored(settled[0], points, max_iterations=1 if len(points) > 2 * SAMPLE else MAX_ITERATIONS)
    if not solved or not _is_even(solved[0], points):
        return None
    model, covariance = solved
    cone = Cone(model.frame[2], model.anchor - model.height * model.frame[2], np.float64(model.half_angle))
    return FullCone(cone, model.sigma, covariance, model.frame)


def _scored(model: _Model, points, *, max_iterations: int) -> tuple[_Model, Float[np.ndarray, "6 6"]] | None:
    """Fisher scoring until a step is small, and the covariance; None where it leaves the cones or goes on and on."""
    for iteration in range(max_iterations):
        scores = _scores(model, points)
        free = np.array([True] * 7 + [model.ends[0] > 0.0, True])  # a cone may end in its apex
        information = scores[:, free].T @ scores[:, free]
        unit = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        values, vectors = np.linalg.eigh(unit[:, None] * information * unit[None, :])
        if not values[0] > 1e-9:
            return None
        inverse = unit[:, None] * (vectors / values) @ vectors.T * unit[None, :]
        step = np.zeros(9)
        step[free] = inverse @ scores[:, free].sum(axis=0)
        moved = _moved(model, step)
        if moved is None:
            return None
        model = moved
        left = np.abs(step[free]) / np.sqrt(np.diag(inverse))
        if np.all(left < (CONVERGED if iteration + 1 < max_iterations else MAX_LAST)):
            return model, inverse[:6, :6]
    return None


def _first_model(start: Cone, frame, sigma: float, points) -> _Model | None:
    """The start, with s0 and s1 from mean and variance of the squared slant, which is even between their squares."""
    axis, apex, half_angle = np.asarray(frame)[2], np.asarray(start.apex), float(start.half_angle)
    height = -float(apex @ axis)
    model = _Model(np.asarray(frame), apex + height * axis, height, half_angle, sigma, (0.0, 1.0))
    x, y, z = _local(model, points)
    sq_slant = (np.hypot(x, y) * math.sin(half_angle) + z * math.cos(half_angle)) ** 2
    mean, variance = float(sq_slant.mean()) - sigma**2, float(sq_slant.var())
    spread = math.sqrt(3.0 * max(variance - 4.0 * sigma**2 * mean, 0.0))
    if not (height > 0.0 and sigma > 0.0 and mean > 0.0 and spread > 0.0):
        return None
    first = math.sqrt(max(mean - spread, 0.0))
    return model._replace(ends=(first if first > 2.0 * sigma else 0.0, math.sqrt(mean + spread)))


def _local(model: _Model, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 n"]:
    """Coordinates in the frame, from the apex."""
    apex = model.anchor - model.height * model.frame[2]
    return model.frame @ (points - apex).T


def _num_nodes(model: _Model) -> int:
    return 12 + math.ceil(NODES_PER_SIGMA * (model.ends[1] - model.ends[0]) / model.sigma)


def _scores(model: _Model, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 9"]:
    """Derivative of every point's log density with respect to the unknowns."""
    x, y, z = _local(model, points)
    rho = np.maximum(np.hypot(x, y), 1e-12 * model.ends[1])
    place, weight = np.polynomial.legendre.leggauss(_num_nodes(model))
    place, weight = (place + 1.0) / 2.0, weight / 2.0
    parts = [
        _of_profile(model, rho[rows], z[rows], place, weight)
        for rows in (slice(first, first + CHUNK) for first in range(0, len(points), CHUNK))
    ]
    by_rho, by_height, by_angle, by_sigma, by_first, by_last = np.concatenate(parts, axis=1)
    over_anchor, out_x, out_y = z - model.height, x / rho, y / rho
    sine, cosine = math.sin(model.half_angle), math.cos(model.half_angle)
    columns = [
        by_height * x - by_rho * out_x * over_anchor,
        by_height * y - by_rho * out_y * over_anchor,
        -by_rho * out_x,
        -by_rho * out_y,
        by_height / sine,
        # Opening about the generator's point at the anchor brings the apex nearer.
        by_angle - by_height * model.height / (sine * cosine),
        by_sigma,
        by_first,
        by_last,
    ]
    return np.stack(columns, axis=1)


def _of_profile(model: _Model, rho, z, place, weight) -> Float[np.ndarray, "6 n"]:
    """Derivatives of the log density by rho, z, half-angle, sigma, s0 and s1: means over the nodes, given the point."""
    (first, last), sq_sigma = model.ends, model.sigma**2
    slant = first + (last - first) * place
    on_generator = rho * math.sin(model.half_angle) + z * math.cos(model.half_angle)
    low, high = on_generator.min() - REACH * model.sigma, on_generator.max() + REACH * model.sigma
    near = (slant > min(low, slant[-1] - REACH * model.sigma)) & (slant < max(high, slant[0] + REACH * model.sigma))
    slant, place, weight = slant[near], place[near], weight[near]
    r, h = slant * math.sin(model.half_angle), slant * math.cos(model.half_angle)
    product = rho[:, None] * r[None, :] / sq_sigma
    scaled = special.i0e(product)  # I0 exp(-product), and so is what stands in the exponent
    exponent = -((rho[:, None] - r[None, :]) ** 2 + (z[:, None] - h[None, :]) ** 2) / (2.0 * sq_sigma)
    exponent -= exponent.max(axis=1, keepdims=True)
    share = np.exp(exponent) * (scaled * (weight * r)[None, :])
    share /= share.sum(axis=1, keepdims=True)
    turned = share * (special.i1e(product) / scaled)  # times the mean cosine between the point and its foot
    means = share @ np.stack([h, slant, h * place, r * place, np.ones_like(r), 1.0 / slant, place / slant], axis=1)
    h_mean, slant_mean, h_place, r_place, _, inverse, place_inverse = means.T
    r_turned, rh_turned = (turned @ np.stack([r, h], axis=1)).T
    sine_place, sine_first = (turned @ np.stack([place, 1.0 - place], axis=1)).T * math.sin(model.half_angle)
    sine, cosine = math.sin(model.half_angle), math.cos(model.half_angle)
    sq_slant = share @ slant**2
    by_rho = (r_turned - rho) / sq_sigma
    by_height = (h_mean - z) / sq_sigma
    by_angle = (rho * rh_turned - z * slant_mean * sine) / sq_sigma
    distance = rho**2 + z**2 + sq_slant - 2.0 * rho * r_turned - 2.0 * z * h_mean
    by_sigma = distance / model.sigma**3 - 3.0 / model.sigma
    # (rho B - r) sin + (z - h) cos, times the place of the node: r sin + h cos is the slant.
    along_last = rho * sine_place + z * cosine * (share @ place) - share @ (slant * place)
    along_first = rho * sine_first + z * cosine * (share @ (1.0 - place)) - share @ (slant * (1.0 - place))
    area = last**2 - first**2
    by_last = along_last / sq_sigma + place_inverse + 1.0 / (last - first) - 2.0 * last / area
    by_first = along_first / sq_sigma + inverse - place_inverse - 1.0 / (last - first) + 2.0 * first / area
    return np.stack([by_rho, by_height, by_angle, by_sigma, by_first, by_last])


def _moved(model: _Model, step: Float[np.ndarray, "9"]) -> _Model | None:
    """The model after a step; None where it leaves the cones."""
    step = step * min(1.0, 0.3 / max(float(np.abs(step[:7]).max()), 1e-300))
    frame, sine = model.frame, math.sin(model.half_angle)
    axis = frame[2] + step[0] * frame[0] + step[1] * frame[1]
    axis /= np.linalg.norm(axis)
    u = frame[0] - axis * (frame[0] @ axis)
    u /= np.linalg.norm(u)
    anchor = model.anchor + step[2] * frame[0] + step[3] * frame[1]
    radius = (model.height * sine + step[4]) / math.cos(model.half_angle)
    half_angle, sigma = model.half_angle + step[5], model.sigma + step[6]
    first, last = max(model.ends[0] + step[7], 0.0), model.ends[1] + step[8]
    if not (1e-3 < half_angle < math.pi / 2 - 1e-3 and sigma > 0.0 and last > first and radius > 0.0):
        return None
    frame = np.stack([u, np.cross(axis, u), axis])
    return _Model(frame, anchor, radius / math.tan(half_angle), half_angle, sigma, (first, last))


def _is_round(model: _Model, points: Float[np.ndarray, "n 3"]) -> bool:
    """Whether no turn about the axis lacks half of its points: what is seen from one side needs no further look."""
    counts = np.bincount(_turn(model, points), minlength=NUM_TURNS)
    return bool(counts.min() > len(points) / NUM_TURNS / 2.0)


def _turn(model: _Model, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    x, y, _ = _local(model, points)
    return np.minimum((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * NUM_TURNS, NUM_TURNS - 1).astype(int)


def _is_even(model: _Model, points: Float[np.ndarray, "n 3"]) -> bool:
    """Whether counts over turn and height are as the density would have them (chi-squared test).

    The turn is even whatever the noise, and independent of the height, whose distribution is a mixture of normal ones.
    """
    z = _local(model, points)[2]
    place, weight = np.polynomial.legendre.leggauss(_num_nodes(model))
    slant = model.ends[0] + (model.ends[1] - model.ends[0]) * (place + 1.0) / 2.0
    weight = weight * slant / np.sum(weight * slant)
    edges = np.quantile(z, np.linspace(0.0, 1.0, NUM_HEIGHTS + 1)[1:-1])
    below = stats.norm.cdf((edges[:, None] - slant[None, :] * math.cos(model.half_angle)) / model.sigma) @ weight
    expected = np.diff(below, prepend=0.0, append=1.0) * len(z) / NUM_TURNS
    counts = np.zeros((NUM_HEIGHTS, NUM_TURNS))
    np.add.at(counts, (np.searchsorted(edges, z), _turn(model, points)), 1.0)
    chi_squared = float(np.sum((counts - expected[:, None]) ** 2 / np.maximum(expected, 1e-9)[:, None]))
    return bool(stats.chi2.sf(chi_squared, NUM_TURNS * NUM_HEIGHTS - 1) > MIN_PROBABILITY)
