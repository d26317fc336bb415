"""First estimates of one segment from positions alone, for when no normals are at hand.

A plane and a sphere have closed forms. For a cylinder or a cone a direction of the axis turns the rest into linear
least squares: many directions are tried at once, the best few polished on the distances, and the best of those is
taken. All at unit scale: the weighted mean of the points at the origin, their rms distance from it 1. n points.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST, effective_count, frame_of, moments
from jprimfit.primitives.table import MODULES, in_frame_of
from jprimfit.programs import stored
from jprimfit.solvers import least_squares
from jprimfit.types import Cone, Cylinder, Primitive, Sphere

NUM_DIRECTIONS = 64  # on the half sphere, about 20 degrees apart
NUM_POLISHED = 4  # best guesses that are polished
NUM_STEPS = 12
RIDGE = 1e-9  # of the linear systems at unit scale: a guess from a degenerate one is bad, not infinite
MAX_SIZE = 1e3  # of a guess's radius or distance of its apex, in sizes of the segment


class Polished(NamedTuple):
    """The primitive of least squared distances near a start."""

    primitive: Any
    ok: Bool[Array, ""]  # finite, and sound for its kind
    cost: Float[Array, ""]  # weighted sum of the squared distances; inf where not ok
    covariance: Float[Array, "p p"]  # of its step about the origin, if the noise is what the distances leave


@partial(stored, static_argnames="kind")
def search(points: Float[Array, "n 3"], weights: Float[Array, " n"], *, kind: str) -> Polished:
    """The primitives of least squared distances near the best of many guesses, the best first (leading axis)."""
    module = MODULES[kind]
    if kind in ("plane", "sphere"):
        guesses = jax.tree.map(lambda field: field[None], module.fit(points, weights, jnp.zeros_like(points)).primitive)
    else:
        directions = jnp.asarray(_directions(), points.dtype)
        guess = _cylinder_along if kind == "cylinder" else _cone_along
        guesses = jax.vmap(guess, (0, None, None))(directions, points, weights)
        cost = jax.vmap(_cost, (0, None, None))(guesses, points, weights)
        best = jnp.argsort(jnp.where(jnp.isfinite(cost), cost, jnp.inf))[:NUM_POLISHED]
        guesses = jax.tree.map(lambda field: field[best], guesses)
    polished = jax.vmap(polish, (0, None, None))(guesses, points, weights)
    order = jnp.argsort(polished.cost)
    return jax.tree.map(lambda field: field[order], polished)


def bent(points: Float[Array, "n 3"], weights: Float[Array, " n"], *, kind: str) -> Any:
    """Guesses for a patch that noise has made as thick as it is bent: a stack of primitives, none for a plane.

    Least squares may then prefer a small surface inside the blob. Here the patch is a graph z = a + b·t + t·H t / 2
    over the plane of most extent, whose curvature noise can weaken but not turn into that of the blob.
    """
    frame = jnp.linalg.eigh(moments(points, weights).covariance)[1].T[::-1]
    frame = jnp.stack([frame[0], frame[1], jnp.cross(frame[0], frame[1])])
    x, y, z = jnp.matmul(frame, points.T, precision=HIGHEST)
    rows = [jnp.ones_like(x), x, y, x * x / 2, x * y, y * y / 2]
    level, _, _, xx, xy, yy = _solve(rows, z, weights)
    curvatures, directions = jnp.linalg.eigh(jnp.stack([xx, xy, xy, yy]).reshape(2, 2))
    strongest = jnp.argmax(jnp.abs(curvatures))
    flat = jnp.matmul(directions[:, 1 - strongest], frame[:2], precision=HIGHEST)
    normal, foot = frame[2], level * frame[2]

    def radius_of(curvature: Float[Array, ""]) -> Float[Array, ""]:
        bounded = jnp.where(jnp.abs(curvature) < 1 / MAX_SIZE, 1 / MAX_SIZE, curvature)
        return 1 / bounded

    if kind == "sphere":
        radius = radius_of(jnp.mean(curvatures))
        return Sphere((foot + radius * normal)[None], jnp.abs(radius)[None])
    radius = radius_of(curvatures[strongest])
    if kind == "cylinder":
        return Cylinder(flat[None], (foot + radius * normal)[None], jnp.abs(radius)[None])

    def cone(generator: Float[Array, "3"], half_angle: Float[Array, ""]) -> Cone:
        """The cone on which the foot has this generator, the patch's normal and its curvature cos / radius."""
        outwards = -jnp.sign(radius) * normal
        cosine, sine = jnp.cos(half_angle), jnp.sin(half_angle)
        across, axis = cosine * outwards + sine * generator, cosine * generator - sine * outwards
        from_axis = jnp.abs(radius) * cosine
        return Cone(axis, foot - from_axis * (across + cosine / sine * axis), half_angle)

    generators = jnp.stack([flat, -flat, flat, -flat])
    return jax.vmap(cone)(generators, jnp.array([0.3, 0.3, 0.8, 0.8], points.dtype))


def polish(start: Primitive, points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Polished:
    """Levenberg-Marquardt on the distances from a start; on curved surfaces noise biases the answer."""
    module = MODULES[start.kind]
    solution = least_squares.minimise(
        lambda primitive: module.signed_distance(primitive, points),
        start,
        weights,
        retract_fn=module.retract,
        num_freedom=module.NUM_FREEDOM,
        num_steps=NUM_STEPS,
    )
    primitive = module.canonical(solution.state, jnp.zeros(3, points.dtype))
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(field)) for field in primitive])) & jnp.isfinite(solution.cost)
    ok = finite & module.sound(primitive, points, weights / jnp.sum(weights))
    freedom = jnp.maximum(effective_count(weights) - module.NUM_FREEDOM, 1)
    sq_sigma = 2 * solution.cost / jnp.sum(weights) * effective_count(weights) / freedom
    inverse = jnp.linalg.pinv(solution.hessian, hermitian=True) * jnp.sum(weights) / effective_count(weights)
    covariance = in_frame_of(primitive, solution.state, sq_sigma * inverse)
    return Polished(primitive, ok, jnp.where(ok, solution.cost, jnp.inf), covariance)


def _cost(primitive: Primitive, points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Float[Array, ""]:
    return jnp.sum(weights * MODULES[primitive.kind].signed_distance(primitive, points) ** 2)


def _cylinder_along(axis: Float[Array, "3"], points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Cylinder:
    """|u|^2 = 2 u·c + (r^2 - |c|^2), linear in c and the bracket; u the coordinates across the axis."""
    across = frame_of(axis)[:2]
    u = jnp.matmul(points, across.T, precision=HIGHEST)
    x, y, level = _solve([u[:, 0], u[:, 1], jnp.ones_like(weights)], jnp.sum(u * u, axis=1), weights)
    center = jnp.stack([x, y]) / 2
    radius = safe.sqrt(level + jnp.sum(center * center))
    return Cylinder(axis, jnp.matmul(center, across, precision=HIGHEST), jnp.clip(radius, 1e-3, MAX_SIZE))


def _cone_along(axis: Float[Array, "3"], points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Cone:
    """|u - c|^2 = (t h + k)^2: linear in c, t^2, t k and a constant; u across, h along the axis, k = t (h - apex's)."""
    frame = frame_of(axis)
    local = jnp.matmul(points, frame.T, precision=HIGHEST)
    u, h = local[:, :2], local[:, 2]
    rows = [u[:, 0], u[:, 1], h, h * h, jnp.ones_like(h)]
    x, y, double, square, _ = _solve(rows, jnp.sum(u * u, axis=1), weights)
    tangent = jnp.clip(safe.sqrt(square), 0.02, 50)
    # Where the parabola of |u|^2 over h has its vertex the cone has its apex; the axis points away from it.
    height = jnp.clip(-double / (2 * jnp.maximum(square, 1e-4)), -MAX_SIZE, MAX_SIZE)
    apex = jnp.matmul(jnp.stack([x / 2, y / 2, height]), frame, precision=HIGHEST)
    forward = jnp.where(jnp.sum(weights * (h - height)) < 0, -1, 1)
    return Cone(forward * axis, apex, jnp.arctan(tangent))


def _solve(
    rows: list[Float[Array, " n"]], values: Float[Array, " n"], weights: Float[Array, " n"]
) -> Float[Array, " d"]:
    matrix = jnp.stack(rows, axis=1)
    weighted = weights[:, None] * matrix
    normal = jnp.matmul(weighted.T, matrix, precision=HIGHEST)
    scale = jnp.trace(normal) / len(rows)
    factor = jnp.linalg.cholesky(normal + RIDGE * scale * jnp.eye(len(rows), dtype=normal.dtype))
    vector = jnp.matmul(weighted.T, values, precision=HIGHEST)
    return jax.scipy.linalg.cho_solve((factor, True), vector[:, None])[:, 0]


def _directions() -> Float[np.ndarray, "d 3"]:
    """Directions spread evenly over the half sphere z > 0 by the golden angle."""
    order = np.arange(NUM_DIRECTIONS) + 0.5
    z, turn = 1.0 - order / NUM_DIRECTIONS, np.pi * (3.0 - np.sqrt(5.0)) * order
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)
