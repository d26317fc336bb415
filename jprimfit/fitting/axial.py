"""Cylinders and cones of one segment by the corrected equations of primitives/estimation, written out for the host.

Both are round about an axis. With x and y across it and h along it, from the axis point nearest the origin, s = x^2 +
y^2 and r = sqrt(s + blur), both are

    f = a s - l^2,  l = push + slope h,     cylinder: a = 1, push = radius, slope = 0
                                            cone: a = cos^2, push = sin height of that point over the apex, slope = sin

and the instruments are G(r, h) times 1, x or y: with the slant, linear in r and h, and the scale 1 / |grad f| at the
foot, a function of one number linear in r and h,

    tilts slant scale / r (x, y),   shifts scale / r (x, y),   radius or push scale,   half-angle slant scale,

and scale^2 f for the variance v. Derivatives of such products are a few lines, and so is f(X) k = (f - v tr M) k
- v grad f·grad k + v^2 M : hess k. The same Newton steps and the same sandwich as there, without its compiling and in
half of its time. Host code in float64; n points.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jprimfit.fitting import newton, shapes
from jprimfit.geometry import host
from jprimfit.primitives import cone, cylinder
from jprimfit.primitives.common import SQ_BLUR
from jprimfit.primitives.estimation import CONVERGED, MAX_GROWTH, MAX_ITERATIONS, SAMPLES, Estimate
from jprimfit.types import Cone, Cylinder

BLOCK = 8_192  # points summed at a time: their intermediate values stay in the processor's cache


class _State(NamedTuple):
    primitive: Cylinder | Cone
    variance: float
    covariance: Float[np.ndarray, "p p"]
    moved: float  # what the last iteration may have left, in standard errors
    regular: bool
    iteration: int


class _Shape(NamedTuple):
    """A cylinder or cone about its axis; lines are (constant, per r, per h)."""

    frame: Float[np.ndarray, "3 3"]  # rows u, v, axis
    origin: Float[np.ndarray, "3"]  # the axis point nearest the origin
    square: float  # a
    push: float
    slope: float
    slant: tuple[float, float, float]
    half_gradient: tuple[float, float, float]  # the number that the scale is a function of


def estimate(start: Cylinder | Cone, points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"]) -> Estimate:
    """What estimation.estimate gives for a cylinder or cone, for points at unit scale around their weighted mean."""
    with np.errstate(all="ignore"):  # equations that points leave open overflow; `ok` says so
        return _estimate(start, points, weights / weights.sum())


def _estimate(start: Cylinder | Cone, points: np.ndarray, weights: np.ndarray) -> Estimate:
    module = cone if isinstance(start, Cone) else cylinder
    count = 1.0 / float(weights @ weights)
    coordinates = np.ascontiguousarray(points.T)
    first = shapes.canonical(type(start)(*(np.asarray(field, float) for field in start)))
    variance = float(weights @ np.square(shapes.signed_distances(first, coordinates)))
    state = _State(first, variance, np.zeros((module.NUM_FREEDOM,) * 2), np.inf, False, 0)
    for size in SAMPLES:
        stride = len(weights) // size
        if stride >= 2:
            some = np.ascontiguousarray(coordinates[:, ::stride])
            few = weights[::stride] / weights[::stride].sum()
            found = _solve(state, some, few, count, variance)
            state = found._replace(moved=np.inf) if found.moved < CONVERGED else state
    state = _solve(state, coordinates, weights, count, variance)
    freedom = count - module.NUM_FREEDOM - 1.0
    finite = all(np.isfinite(field).all() for field in state.primitive)
    ok = state.regular and finite and state.moved < CONVERGED and freedom > 0.0
    ok = ok and _is_sound(state.primitive, coordinates, weights)
    covariance = np.where(np.isfinite(state.covariance), state.covariance, 0.0) * (count / max(freedom, 1.0))
    found, sigma = state.primitive if ok else start, np.float64(math.sqrt(max(state.variance, 0.0)))
    return Estimate(found, np.bool_(ok), sigma, covariance, np.int32(state.iteration))  # pyright: ignore[reportArgumentType]


def with_doubt(found: Estimate, points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"]) -> Estimate:
    """The estimate with a covariance that makes up for being known from these points only (newton.py)."""
    weights = weights / weights.sum()
    count, variance = 1.0 / float(weights @ weights), float(found.sigma) ** 2
    state = _State(found.primitive, variance, np.zeros((0, 0)), 0.0, True, 0)  # pyright: ignore[reportArgumentType]
    shape = _shape(state.primitive)

    def sums_of(some: slice) -> newton.Sums:
        return _sums(shape, state, np.ascontiguousarray(points[some].T), weights[some], count)

    return newton.with_doubt(found, sums_of, len(points))


def _solve(state: _State, coordinates: np.ndarray, weights: np.ndarray, count: float, first_variance: float) -> _State:
    """Newton's method with the limits and the end that estimation._iterate has."""
    while state.iteration < MAX_ITERATIONS and not state.moved < CONVERGED:
        shape = _shape(state.primitive)
        step = newton.step(_sums(shape, state, coordinates, weights, count), state.variance)
        primitive = shapes.canonical(shapes.retract(state.primitive, step.change[:-1]))
        variance = float(np.clip(state.variance + step.change[-1], 0.0, MAX_GROWTH * first_variance))
        covariance = _turned(step.covariance, shape.frame, host.frame_of(np.asarray(primitive.axis)))
        state = _State(primitive, variance, covariance, step.moved, step.regular, state.iteration + 1)
    return state


def _shape(primitive: Cylinder | Cone) -> _Shape:
    axis = np.asarray(primitive.axis)
    if isinstance(primitive, Cylinder):
        radius = float(primitive.radius)
        center = np.asarray(primitive.center)
        return _Shape(host.frame_of(axis), center, 1.0, radius, 0.0, (0.0, 0.0, 1.0), (radius, 0.0, 0.0))
    cosine, sine = math.cos(float(primitive.half_angle)), math.sin(float(primitive.half_angle))
    height = -float(np.asarray(primitive.apex) @ axis)
    push = height * sine
    slant = (-push * sine / cosine, sine, cosine)
    half_gradient = (cosine * cosine * push, cosine * sine * sine, cosine * cosine * sine)
    return _Shape(
        host.frame_of(axis), primitive.apex + height * axis, cosine * cosine, push, sine, slant, half_gradient
    )


def _sums(shape: _Shape, state: _State, coordinates: np.ndarray, weights: np.ndarray, count: float) -> newton.Sums:
    """The equations, their derivatives by the unknowns, and the covariance of their value; a block of points a time."""
    blocks = (slice(start, start + BLOCK) for start in range(0, len(weights), BLOCK))
    sums = (_block_sums(shape, state, coordinates[:, block], weights[block], count) for block in blocks)
    return newton.Sums(*(np.sum(terms, axis=0) for terms in zip(*sums, strict=True)))


def _block_sums(
    shape: _Shape, state: _State, coordinates: np.ndarray, weights: np.ndarray, count: float
) -> newton.Sums:
    is_cone, v, a = isinstance(state.primitive, Cone), state.variance, shape.square
    x, y, h = shape.frame @ (coordinates - shape.origin[:, None])
    s = x * x + y * y
    reciprocal = 1.0 / np.sqrt(s + SQ_BLUR * v + np.finfo(float).tiny ** 0.5)
    level = shape.push + shape.slope * h
    at = _Points(x, y, h, s, level, a * s - level * level, s * reciprocal, reciprocal)
    num_freedom = cone.NUM_FREEDOM if is_cone else cylinder.NUM_FREEDOM

    scale = _scale(shape, v, 1.0 / reciprocal, h, is_cone)
    shrink = _times_reciprocal(scale, reciprocal)
    constant, slant_r, slant_h = shape.slant
    slant = constant + slant_r / reciprocal + slant_h * h
    value, equation, by_v, slope_x, slope_y, slope_h = terms = np.empty((6, num_freedom + 1, len(s)))
    _write_pair(terms[:, 0:2], shape, v, at, _times_line(shrink, slant, slant_r, slant_h))
    _write_pair(terms[:, 2:4], shape, v, at, shrink)
    _write_single(terms[:, 4], shape, v, at, scale)
    if is_cone:
        _write_single(terms[:, 5], shape, v, at, _times_line(scale, slant, slant_r, slant_h))
    _write_noise(terms[:, -1], shape, v, at, scale)
    used = min(num_freedom / count, 0.9)  # as in estimation: points lie nearer to the surface fitted to them
    equation[-1] += used * v
    by_v[-1] += used

    # k df/dt - v (k tr dM/dt + grad k·grad df/dt), summed, for the tilts, shifts, radius or push, and half-angle.
    terms *= weights
    jacobian = np.empty((num_freedom + 1,) * 2)
    tilting = -2.0 * (h + shape.push * shape.slope)
    jacobian[:, 0] = value @ (tilting * x) - v * (slope_x @ tilting - 2.0 * (slope_h @ x))
    jacobian[:, 1] = value @ (tilting * y) - v * (slope_y @ tilting - 2.0 * (slope_h @ y))
    jacobian[:, 2] = -2.0 * a * (value @ x - v * slope_x.sum(axis=1))
    jacobian[:, 3] = -2.0 * a * (value @ y - v * slope_y.sum(axis=1))
    jacobian[:, 4] = -2.0 * (value @ level - v * shape.slope * slope_h.sum(axis=1))
    if is_cone:
        cosine = math.sqrt(a)
        both, opening = shape.slope * cosine, cosine * h - shape.push * shape.slope / cosine
        opened = -2.0 * both * (s - 3.0 * v) - 2.0 * level * opening
        by_height = -2.0 * (shape.slope * opening + cosine * level)
        jacobian[:, 5] = value @ opened - v * (slope_h @ by_height - 4.0 * both * (slope_x @ x + slope_y @ y))
    jacobian[:, -1] = by_v.sum(axis=1)
    return newton.Sums(equation.sum(axis=1), jacobian, equation @ equation.T)


class _Points(NamedTuple):
    """What the equations ask of each point."""

    x: np.ndarray
    y: np.ndarray
    h: np.ndarray
    s: np.ndarray
    level: np.ndarray  # l
    f: np.ndarray
    s_over_r: np.ndarray
    reciprocal: np.ndarray  # 1 / r


class _Product(NamedTuple):
    """A function of r and h at each point, with derivatives."""

    value: np.ndarray
    by_r: np.ndarray
    by_h: np.ndarray
    by_rr: np.ndarray
    by_hh: np.ndarray


def _scale(shape: _Shape, v: float, r: np.ndarray, h: np.ndarray, is_cone: bool) -> _Product:
    """1 / |grad f| at the foot of each point; on a cone it levels off towards the apex."""
    if not is_cone:
        constant, zero = np.full_like(r, 0.5 / shape.push if shape.push else 0.0), np.zeros_like(r)
        return _Product(constant, zero, zero, zero, zero)
    constant, by_r, by_h = shape.half_gradient
    length = constant + by_r * r + by_h * h
    blur = cone.SQ_APEX_BLUR * v * shape.slope**2 * shape.square + np.finfo(float).tiny ** 0.5
    reciprocal = 1.0 / (length * length + blur)
    value = 0.5 * length * reciprocal
    first = 0.5 * reciprocal - 4.0 * value * value
    second = -2.0 * value * reciprocal - 8.0 * value * first
    return _Product(value, by_r * first, by_h * first, by_r * by_r * second, by_h * by_h * second)


def _times_reciprocal(of: _Product, reciprocal: np.ndarray) -> _Product:
    value = of.value * reciprocal
    by_r = (of.by_r - value) * reciprocal
    return _Product(value, by_r, of.by_h * reciprocal, (of.by_rr - 2.0 * by_r) * reciprocal, of.by_hh * reciprocal)


def _times_line(of: _Product, line: np.ndarray, by_r: float, by_h: float) -> _Product:
    return _Product(
        of.value * line,
        of.by_r * line + of.value * by_r,
        of.by_h * line + of.value * by_h,
        of.by_rr * line + 2.0 * by_r * of.by_r,
        of.by_hh * line + 2.0 * by_h * of.by_h,
    )


def _parts(shape: _Shape, v: float, at: _Points, of: _Product, degree: float) -> tuple[np.ndarray, np.ndarray]:
    """f(X) k and its derivative by v, for k = G c with c = 1 (degree 0), or x or y (1), both over c."""
    radial = of.by_r * at.s_over_r + degree * of.value
    along = 2.0 * shape.square * radial - 2.0 * shape.slope * at.level * of.by_h
    curved = shape.square * _laplace(at, of, degree) - shape.slope**2 * of.by_hh
    by_v = 2.0 * v * curved - _trace(shape) * of.value - along
    return at.f * of.value + v * (by_v - v * curved), by_v


def _laplace(at: _Points, of: _Product, degree: float) -> np.ndarray:
    """(d^2 / dx^2 + d^2 / dy^2) (G c) / c."""
    over_r = at.s_over_r * at.reciprocal  # s / r^2
    return of.by_rr * over_r + of.by_r * at.reciprocal * (2.0 + 2.0 * degree - over_r)


def _trace(shape: _Shape) -> float:
    return 2.0 * shape.square - shape.slope**2


def _write_pair(terms: np.ndarray, shape: _Shape, v: float, at: _Points, of: _Product) -> None:
    """For k = G x and k = G y: k, f(X) k, its derivative by v, and the gradient of k."""
    whole, by_v = _parts(shape, v, at, of, 1.0)
    turned = of.by_r * at.reciprocal
    for row, factor in enumerate((at.x, at.y)):
        terms[0, row], terms[1, row], terms[2, row] = of.value * factor, whole * factor, by_v * factor
        terms[3, row], terms[4, row] = turned * at.x * factor, turned * at.y * factor
        terms[3 + row, row] += of.value
        terms[5, row] = of.by_h * factor


def _write_single(terms: np.ndarray, shape: _Shape, v: float, at: _Points, of: _Product) -> None:
    """The same for k = G."""
    turned = of.by_r * at.reciprocal
    terms[0], (terms[1], terms[2]) = of.value, _parts(shape, v, at, of, 0.0)
    terms[3], terms[4], terms[5] = turned * at.x, turned * at.y, of.by_h


def _write_noise(terms: np.ndarray, shape: _Shape, v: float, at: _Points, scale: _Product) -> None:
    """The same for k = P f with P = scale^2."""
    a, slope, two_level, f = shape.square, shape.slope, 2.0 * shape.slope * at.level, at.f
    of = _Product(
        scale.value**2,
        2.0 * scale.value * scale.by_r,
        2.0 * scale.value * scale.by_h,
        2.0 * (scale.by_r**2 + scale.value * scale.by_rr),
        2.0 * (scale.by_h**2 + scale.value * scale.by_hh),
    )
    radial, turned = of.by_r * at.s_over_r, of.by_r * at.reciprocal
    value = of.value * f
    along = of.value * (4.0 * a * a * at.s + two_level**2) + f * (2.0 * a * radial - two_level * of.by_h)
    curved = f * (a * _laplace(at, of, 0.0) - slope**2 * of.by_hh) + of.value * (4.0 * a * a + 2.0 * slope**4)
    curved += 4.0 * a * a * radial + 2.0 * slope**2 * two_level * of.by_h
    by_v = 2.0 * v * curved - _trace(shape) * value - along
    terms[0], terms[1], terms[2] = value, f * value + v * (by_v - v * curved), by_v
    steep = turned * f + 2.0 * a * of.value
    terms[3], terms[4], terms[5] = steep * at.x, steep * at.y, of.by_h * f - of.value * two_level


def _turned(covariance: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """`table.in_frame_of`: the covariance in the coordinates of another frame."""
    turn, across = np.eye(len(covariance)), new[:2] @ old[:2].T
    turn[:2, :2], turn[2:4, 2:4] = np.sign(old[2] @ new[2]) * across, across
    return turn @ covariance @ turn.T


def _is_sound(primitive: Cylinder | Cone, coordinates: np.ndarray, weights: np.ndarray) -> bool:
    """`sound` of primitives/cylinder.py and cone.py."""
    if isinstance(primitive, Cylinder):
        return bool(primitive.radius > 0.0)
    inside = primitive.axis @ (coordinates - primitive.apex[:, None]) > 0.0
    on_nappe = float(weights @ inside)
    return bool(cone.MIN_HALF_ANGLE < primitive.half_angle < cone.MAX_HALF_ANGLE and on_nappe > cone.MIN_ON_NAPPE)
