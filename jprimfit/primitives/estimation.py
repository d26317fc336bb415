"""Estimates that noise does not bias, for all four kinds and any part of the surface, with their covariance.

Least squares of the distances sees a curved surface from outside: with noise of standard deviation s the radius of a
sphere comes out s^2 / r too large, and that of a patch anything. Here the equations are corrected, not the answer.
Least squares solves sum f k = 0, with f = 0 the quadric and k the derivative of the distance by the unknowns over
|grad f|. The sum of f(X) k (see `quadrics`) has the same solution for clean points and, with v = s^2, the expectation 0
for noisy ones, wherever on the surface they belong: nothing is assumed about which part was seen, or how densely. One
more equation, f(X) (f / |grad f|^2) = 0, gives v. (Adjusted least squares: Kukush, Markovsky & Van Huffel 2004, with
k = df/dt. Here k is constant along the normals, so that noise across the surface does not enter it.)

The covariance is the sandwich A^-1 B A^-T of these equations, that of v included: it holds for any part of the surface,
too. n points, p unknowns of the step, q = p + 1.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST, weighted_mean
from jprimfit.primitives.common import Standard, standardise
from jprimfit.primitives.table import in_frame_of, of
from jprimfit.types import Primitive

MAX_ITERATIONS = 30
SAMPLES = (4_096, 16_384)  # points of the first iterations
CHUNK = 512  # points at a time
MAX_GROWTH = 4.0  # of the variance over the mean squared distance from the start
MAX_STEP = 0.3  # of one iteration, in radians and rms sizes of the segment
CONVERGED = 2e-2  # what the last step may leave, in standard errors


class Estimate(NamedTuple):
    """A primitive and what the points say of its accuracy."""

    primitive: Primitive
    ok: Bool[Array, ""]  # the equations are regular and were solved; where not, the primitive is the start
    sigma: Float[Array, ""]  # standard deviation of the noise in each coordinate, length
    covariance: Float[Array, "p p"]  # of the primitive's step (`retract`) about the weighted mean of the points
    num_iterations: Int[Array, ""]


class _Equations(NamedTuple):
    """Weighted sums of mean 0 at the true primitive and variance; the last belongs to the variance."""

    value: Float[Array, " q"]
    jacobian: Float[Array, "q q"]  # expectation of the derivative by the step and the variance
    covariance: Float[Array, "q q"]  # of the value


class _State(NamedTuple):
    primitive: Primitive  # at unit scale
    variance: Float[Array, ""]
    covariance: Float[Array, "p p"]  # of the step, as it was before the last iteration
    moved: Float[Array, ""]  # what the last iteration may have left, in standard errors
    iteration: Int[Array, ""]


def estimate(start: Primitive, points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Estimate:
    """The primitive of the start's kind that solves the corrected equations, by Newton's method.

    weights: >= 0, not all equal where some points are doubtful; scaling them changes nothing. The derivatives with
    respect to points and weights are those of the solution (implicit function theorem); the start has none.
    """
    module, standard = of(start), standardise(points, weights)
    fixed = jax.lax.stop_gradient(standard)
    state = _solve(jax.lax.stop_gradient(_localised(start, fixed)), fixed)
    _, regular = _inverse(_equations(state.primitive, state.variance, _sample(fixed, SAMPLES[0])).jacobian)
    change = _at_rest(state.primitive, state.variance, standard)
    solved = module.retract(state.primitive, change[:-1])
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in solved]))
    freedom = fixed.count - module.NUM_FREEDOM - 1
    ok = regular & finite & (state.moved < CONVERGED) & (freedom > 0)
    ok = ok & module.sound(solved, fixed.local, fixed.weights)
    covariance = state.covariance * safe.divide(fixed.count, jnp.maximum(freedom, 1))
    units = fixed.scale ** jnp.asarray(module.STEP_UNITS, points.dtype)
    covariance = jnp.where(jnp.isfinite(covariance), units[:, None] * covariance * units[None, :], 0)
    found = _globalised(module.canonical(solved, weighted_mean(standard.local, standard.weights)), fixed)
    primitive = jax.tree.map(lambda new, old: jnp.where(ok, new, old), found, jax.lax.stop_gradient(start))
    sigma = fixed.scale * safe.sqrt(state.variance + change[-1])
    return Estimate(primitive, ok, sigma, covariance, state.iteration)


@jax.custom_jvp
def _at_rest(primitive: Primitive, variance: Float[Array, ""], standard: Standard) -> Float[Array, " q"]:
    """The step 0 from a solution; it follows the points and weights as the solution does."""
    return jnp.zeros(of(primitive).NUM_FREEDOM + 1, variance.dtype)


@_at_rest.defjvp
def _at_rest_jvp(primals, tangents):
    primitive, variance, standard = primals

    def value(unknown: Float[Array, " q"], standard: Standard) -> Float[Array, " q"]:
        moved = of(primitive).retract(primitive, unknown[:-1])
        return _equations(moved, variance + unknown[-1], standard).value

    at = _at_rest(primitive, variance, standard)
    inverse, _ = _inverse(jax.jacfwd(value)(at, standard))
    _, change = jax.jvp(lambda standard: value(at, standard), (standard,), (tangents[2],))
    return at, -jnp.matmul(inverse, change, precision=HIGHEST)


def _solve(start: Primitive, standard: Standard) -> _State:
    """Newton's method, first on every so many points, because all of them only have to add the last digits."""
    first = _mean_square(start, standard)
    unsolved, nothing = jnp.full_like(first, jnp.inf), jnp.zeros((of(start).NUM_FREEDOM,) * 2, first.dtype)
    state = _State(start, first, nothing, unsolved, jnp.zeros((), jnp.int32))
    for size in SAMPLES:
        if len(standard.weights) >= 2 * size:
            found = _iterate(state, _sample(standard, size))
            state = _chosen(found.moved < CONVERGED, found, state)._replace(moved=unsolved)
    return _iterate(state, standard)


def _chosen(condition: Bool[Array, ""], this: _State, other: _State) -> _State:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), this, other)


def _sample(standard: Standard, size: int) -> Standard:
    """Every so many points, so that about that many are left."""
    stride = max(1, len(standard.weights) // size)
    return standard._replace(local=standard.local[::stride], weights=standard.weights[::stride])


def _iterate(first: _State, standard: Standard) -> _State:
    module, origin = of(first.primitive), jnp.zeros_like(standard.center)

    def step(state: _State) -> _State:
        equations = _equations(state.primitive, state.variance, standard)
        inverse, _ = _inverse(equations.jacobian)
        change = -jnp.matmul(inverse, equations.value, precision=HIGHEST)
        change = jnp.where(jnp.all(jnp.isfinite(change)), change, 0)
        # Where the points fit exactly the standard errors are 0, and what is left of a step is rounding.
        rounding = 100 * jnp.finfo(change.dtype).eps * jnp.sum(jnp.abs(inverse), axis=1)
        covariance = _propagated(inverse, equations)
        errors = safe.sqrt(jnp.diagonal(covariance)) + rounding / CONVERGED
        length = jnp.max(jnp.abs(change[:-1]))
        # Of a step that is small against the segment the next one is the square.
        moved = jnp.max(jnp.abs(change[:-1]) / errors[:-1]) * jnp.minimum(1, 3 * length)
        # Of noise that was only distance from the solution the standard errors are too large.
        exact = (1e3 * jnp.finfo(change.dtype).eps) ** 2
        moved = jnp.where(jnp.abs(change[-1]) <= 0.1 * state.variance + exact, moved, jnp.inf)
        change = change * jnp.minimum(1, safe.divide(jnp.full_like(length, MAX_STEP), length))
        primitive = module.canonical(module.retract(state.primitive, change[:-1]), origin)
        variance = jnp.clip(state.variance + change[-1], 0, MAX_GROWTH * first.variance)
        covariance = in_frame_of(primitive, state.primitive, covariance[:-1, :-1])
        return _State(primitive, variance, covariance, moved, state.iteration + 1)

    def unfinished(state: _State) -> Bool[Array, ""]:
        return (state.iteration < MAX_ITERATIONS) & ~(state.moved < CONVERGED)

    return jax.lax.while_loop(unfinished, step, first)


def _equations(primitive: Primitive, variance: Float[Array, ""], standard: Standard) -> _Equations:
    """The sums over all points, a chunk at a time, so that what is made of a point stays in the cache."""
    num_points = len(standard.weights)
    num_chunks = -(-num_points // CHUNK)
    if num_chunks == 1:
        return _summed(primitive, variance, standard, standard.local, standard.weights)
    padding = num_chunks * CHUNK - num_points
    points = jnp.pad(standard.local, ((0, padding), (0, 0))).reshape(num_chunks, CHUNK, 3)
    weights = jnp.pad(standard.weights, (0, padding)).reshape(num_chunks, CHUNK)
    zero = jax.tree.map(
        lambda field: jnp.zeros(field.shape, field.dtype),
        jax.eval_shape(lambda: _summed(primitive, variance, standard, points[0], weights[0])),
    )

    def add(total: _Equations, chunk):
        return jax.tree.map(jnp.add, total, _summed(primitive, variance, standard, *chunk)), None

    return jax.lax.scan(add, zero, (points, weights))[0]


def _summed(
    primitive: Primitive, variance: Float[Array, ""], standard: Standard, points, weights: Float[Array, " n"]
) -> _Equations:
    module = of(primitive)
    quadric = module.quadric(primitive)
    surface = quadric.value(points)
    gradient = _along_frame(quadric.frame, 2 * quadric.matrix, quadric.vector, points)

    def instruments(at: Float[Array, "n 3"]) -> Float[Array, "q n"]:
        found = module.instruments(primitive, at, variance)
        return jnp.stack([*found.weights, found.scale * found.scale * quadric.value(at)])

    values, first, second = _derivatives(instruments, points, quadric.frame)
    # d/dv of f(X) k, and f(X) k itself; q n.
    curved = jnp.sum(quadric.curvature[:, None, None] * second, axis=0)
    along = jnp.sum(gradient[:, None, :] * first, axis=0)
    by_variance = 2 * variance * curved - jnp.sum(quadric.curvature) * values - along
    equations = surface[None, :] * values + variance * (by_variance - variance * curved)
    # Points lie nearer to the surface fitted to them than to the true one, by p of n degrees of freedom.
    used = jnp.minimum(safe.divide(jnp.full_like(variance, module.NUM_FREEDOM), standard.count), 0.9)
    equations, by_variance = equations.at[-1].add(used * variance), by_variance.at[-1].add(used)

    weighted = weights[None, :] * equations
    by_step = _by_step(
        module, primitive, variance, points, weights[None, :] * values, [weights[None, :] * d for d in first]
    )
    return _Equations(
        jnp.sum(weighted, axis=1),
        jnp.column_stack([by_step, jnp.matmul(by_variance, weights, precision=HIGHEST)]),
        jnp.matmul(weighted, weighted.T, precision=HIGHEST),
    )


def _derivatives(function, points: Float[Array, "n 3"], frame: Float[Array, "3 3"]):
    """A function of points, (q, n), and its first and second derivatives along each row of a frame."""

    def along(row: Float[Array, "3"]):
        tangent = jnp.broadcast_to(row[None, :], points.shape)

        def first(at: Float[Array, "n 3"]):
            return jax.jvp(function, (at,), (tangent,))

        (values, slope), (_, curvature) = jax.jvp(first, (points,), (tangent,))
        return values, slope, curvature

    return jax.vmap(along, out_axes=(None, 0, 0))(frame)


def _along_frame(frame, matrix, vector, points: Float[Array, "n 3"]) -> Float[Array, "3 n"]:
    """Of the vectors matrix x + vector at each point x, the components along the rows of a frame."""
    turned = jnp.matmul(frame, matrix, precision=HIGHEST)
    return jnp.matmul(turned, points.T, precision=HIGHEST) + jnp.matmul(frame, vector, precision=HIGHEST)[:, None]


def _by_step(module, primitive: Primitive, variance, points, values: Float[Array, "q n"], first) -> Float[Array, "q p"]:
    """The derivative of the sums by the step: sums of df/dt(X) k, values and derivatives of k weighted.

    What dk/dt would add has mean 0; v^2 M : hess k is left out, a part of 1e-3 at most.
    """

    def polynomial(step: Float[Array, " p"]):
        moved = module.quadric(module.retract(primitive, step))
        return moved.matrix, moved.vector, moved.constant

    matrix, vector, constant = jax.jacfwd(polynomial)(jnp.zeros(module.NUM_FREEDOM, variance.dtype))
    x, y, z = points.T
    one = jnp.ones_like(x)
    squares = jnp.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, x, y, z, one], axis=1)
    row, column = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
    constant = constant - variance * jnp.trace(matrix)
    moved = jnp.concatenate([matrix[row, column], vector, constant[None]])
    total = jnp.matmul(jnp.matmul(values, squares, precision=HIGHEST), moved, precision=HIGHEST)
    for direction, derivative in zip(module.quadric(primitive).frame, first, strict=True):
        linear = 2 * jnp.einsum("c,cdp->dp", direction, matrix, precision=HIGHEST)
        level = jnp.matmul(direction, vector, precision=HIGHEST)
        sums = jnp.matmul(derivative, squares[:, 6:], precision=HIGHEST)
        slope = jnp.matmul(sums, jnp.concatenate([linear, level[None]]), precision=HIGHEST)
        total = total - variance * slope
    return total


def _mean_square(primitive: Primitive, standard: Standard) -> Float[Array, ""]:
    return jnp.sum(standard.weights * of(primitive).signed_distance(primitive, standard.local) ** 2)


def _inverse(jacobian: Float[Array, "q q"]) -> tuple[Float[Array, "q q"], Bool[Array, ""]]:
    """The inverse by singular values at unit scale of rows and columns, those cut that rounding alone could leave."""
    finite = jnp.all(jnp.isfinite(jacobian))
    jacobian = jnp.where(finite, jacobian, jnp.eye(len(jacobian), dtype=jacobian.dtype))
    rows = _reciprocal(jnp.max(jnp.abs(jacobian), axis=1))
    columns = _reciprocal(jnp.max(jnp.abs(rows[:, None] * jacobian), axis=0))
    left, values, right = jnp.linalg.svd(rows[:, None] * jacobian * columns[None, :])
    least = 100 * jnp.finfo(values.dtype).eps * values[0]
    inverse = jnp.matmul(right.T / jnp.maximum(values, least)[None, :], left.T, precision=HIGHEST)
    return columns[:, None] * inverse * rows[None, :], finite & (values[-1] > least)


def _propagated(inverse: Float[Array, "q q"], equations: _Equations) -> Float[Array, "q q"]:
    half = jnp.matmul(inverse, equations.covariance, precision=HIGHEST)
    return jnp.matmul(half, inverse.T, precision=HIGHEST)


def _reciprocal(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    return safe.divide(jnp.ones_like(x), x)


def _localised(primitive: Primitive, standard: Standard) -> Primitive:
    turn = jnp.eye(3, dtype=standard.center.dtype)
    module = of(primitive)
    local = module.transform(primitive, turn, -standard.center / standard.scale, 1 / standard.scale)
    return module.canonical(local, jnp.zeros_like(standard.center))


def _globalised(primitive: Primitive, standard: Standard) -> Primitive:
    turn = jnp.eye(3, dtype=standard.center.dtype)
    return of(primitive).transform(primitive, turn, standard.center, standard.scale)
