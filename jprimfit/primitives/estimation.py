"""Estimates that noise does not bias, for all four kinds and any part of the surface, with their covariance.

Least squares of the distances sees a curved surface from outside: with noise of standard deviation s the radius of a
sphere comes out s^2 / r too large, and that of a patch anything. Here the equations are corrected, not the answer. Let
f(x; t) = 0 be the quadric and g = 1 / |grad f|^2. The sum of f df/dt g over clean points is 0 at the true t. A noisy
point gives the same expectation once every term F in it is replaced by exp(-v Laplace / 2) F, v = s^2, whatever point
of the surface it belongs to: nothing is assumed about where the surface was seen. The equation of f f g gives v.
(Adjusted least squares, with g = 1: Kukush, Markovsky & Van Huffel 2004.)

g = 1 / 4 (L^2 + l^2), L(x) linear with |grad f| = 2 |L| on the surface: constant but for cones, where L grows from the
apex and l keeps g smooth at the scale of the noise. The covariance is the sandwich A^-1 B A^-T of these equations, the
one of v included, so that it holds for any part of the surface, too. n points, p unknowns of the step, q = p + 1.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST
from jprimfit.primitives.common import Standard, standardise
from jprimfit.primitives.quadrics import Quadric, derivative, monomials, noise_term
from jprimfit.primitives.table import of
from jprimfit.types import Primitive

SMOOTHNESS = 3.0  # l over the standard deviation that the noise gives to L
MAX_ITERATIONS = 30
MAX_STEP = 0.3  # of one iteration, in radians and rms sizes of the segment
CONVERGED = 1e-2  # the last step, in standard errors; Newton leaves far less


class Estimate(NamedTuple):
    """A primitive and what the points say of its accuracy."""

    primitive: Primitive
    ok: Bool[Array, ""]  # the equations are regular and were solved; where not, the primitive is the start
    sigma: Float[Array, ""]  # standard deviation of the noise in each coordinate, length
    covariance: Float[Array, "p p"]  # of the primitive's step (`retract`) about the weighted mean of the points
    num_iterations: Int[Array, ""]


class _Equations(NamedTuple):
    value: Float[Array, " q"]  # weighted sums; those of the step, then that of v
    jacobian: Float[Array, "q q"]
    covariance: Float[Array, "q q"]  # of the value


class _State(NamedTuple):
    primitive: Primitive  # at unit scale
    variance: Float[Array, ""]
    moved: Float[Array, ""]  # by the last iteration, in standard errors
    iteration: Int[Array, ""]


def estimate(start: Primitive, points: Float[Array, "n 3"], weights: Float[Array, " n"]) -> Estimate:
    """The primitive of the start's kind that solves the corrected equations, by Newton's method.

    weights: >= 0, not all equal where some points are doubtful; scaling them changes nothing. The derivatives with
    respect to points and weights are those of the solution (implicit function theorem); the start has none.
    """
    module, standard = of(start), standardise(points, weights)
    fixed = jax.lax.stop_gradient(standard)
    state = _solve(jax.lax.stop_gradient(_localised(start, fixed)), fixed)
    equations = _equations(state.primitive, state.variance, fixed)
    inverse, regular = _inverse(equations.jacobian)
    residual = _equations(state.primitive, state.variance, standard).value
    change = -jnp.matmul(inverse, residual - jax.lax.stop_gradient(residual), precision=HIGHEST)
    solved = module.retract(state.primitive, change[:-1])
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((solved, inverse))]))
    freedom = fixed.count - module.NUM_FREEDOM - 1
    ok = regular & finite & (state.moved < CONVERGED) & (freedom > 0) & module.sound(solved, fixed.local, fixed.weights)
    covariance = _propagated(inverse, equations)[:-1, :-1] * safe.divide(fixed.count, jnp.maximum(freedom, 1))
    units = fixed.scale ** jnp.asarray(module.STEP_UNITS, points.dtype)
    covariance = jnp.where(jnp.isfinite(covariance), units[:, None] * covariance * units[None, :], 0)
    found = _globalised(solved, fixed)
    primitive = jax.tree.map(lambda new, old: jnp.where(ok, new, old), found, jax.lax.stop_gradient(start))
    sigma = fixed.scale * safe.sqrt(state.variance + change[-1])
    return Estimate(primitive, ok, sigma, covariance, state.iteration)


def _solve(start: Primitive, standard: Standard) -> _State:
    module, origin = of(start), jnp.zeros_like(standard.center)
    first = _mean_square(start, standard)

    def step(state: _State) -> _State:
        equations = _equations(state.primitive, state.variance, standard)
        inverse, _ = _inverse(equations.jacobian)
        change = -jnp.matmul(inverse, equations.value, precision=HIGHEST)
        change = jnp.where(jnp.all(jnp.isfinite(change)), change, 0)
        errors = safe.sqrt(jnp.diagonal(_propagated(inverse, equations)))[:-1]
        # Where the points fit exactly the standard errors are 0, and what is left of a step is rounding.
        rounding = 100 * jnp.finfo(errors.dtype).eps * jnp.sum(jnp.abs(inverse), axis=1)[:-1]
        moved = jnp.max(jnp.abs(change[:-1]) / (errors + rounding / CONVERGED))
        length = jnp.max(jnp.abs(change[:-1]))
        change = change * jnp.minimum(1, safe.divide(jnp.full_like(length, MAX_STEP), length))
        primitive = module.canonical(module.retract(state.primitive, change[:-1]), origin)
        variance = jnp.clip(state.variance + change[-1], 0, 4 * first)
        return _State(primitive, variance, moved, state.iteration + 1)

    def unfinished(state: _State) -> Bool[Array, ""]:
        return (state.iteration < MAX_ITERATIONS) & ~(state.moved < CONVERGED)

    state = _State(start, first, jnp.full_like(first, jnp.inf), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unfinished, step, state)


def _equations(primitive: Primitive, variance: Float[Array, ""], standard: Standard) -> _Equations:
    module = of(primitive)
    quadric = module.quadric(primitive)

    def moved(step: Float[Array, " p"]) -> Float[Array, "10"]:
        return module.quadric(module.retract(primitive, step)).polynomial

    partial = jax.jacfwd(moved)(jnp.zeros(module.NUM_FREEDOM, variance.dtype))
    values, jacobian = _corrected(quadric, jnp.column_stack([partial, quadric.polynomial]), variance, standard)
    # Points lie nearer to the surface fitted to them than to the true one, by p of n degrees of freedom.
    used = jnp.minimum(safe.divide(jnp.full_like(variance, module.NUM_FREEDOM), standard.count), 0.9)
    values = values.at[:, -1].add(used * variance)
    weighted = standard.weights[:, None] * values
    value = jnp.sum(weighted, axis=0)
    jacobian = jacobian.at[-1, :-1].set(2 * value[:-1]).at[-1, -1].add(used)
    return _Equations(value, jacobian, jnp.matmul(weighted.T, weighted, precision=HIGHEST))


def _corrected(
    quadric: Quadric, factors: Float[Array, "10 q"], variance: Float[Array, ""], standard: Standard
) -> tuple[Float[Array, "n q"], Float[Array, "q q"]]:
    """exp(-v Laplace / 2) (f factor g) for every point and factor, and the Jacobian of their weighted sums.

    With d = slope·grad, F = f factor, F' = exp(-v Laplace / 2) F and g a function of L only, it is the sum over m of
    (-v)^m / m! (d^m F') (d/dL)^m g. The Jacobian is that of the expectation, where terms with f vanish; its
    corrections take g as constant.
    """
    surface = quadric.polynomial
    at_points = monomials(standard.local)
    weights = _line_weights(quadric, variance, standard.local)
    surface_derivatives, factor_derivatives = [surface], [factors]
    if quadric.slope is not None:
        along = jax.vmap(derivative, (1, None), 1)
        for _ in range(2):
            surface_derivatives.append(derivative(surface_derivatives[-1], quadric.slope))
            factor_derivatives.append(along(factor_derivatives[-1], quadric.slope))
    surface_values = [jnp.matmul(at_points, a, precision=HIGHEST) for a in surface_derivatives]
    factor_values = [jnp.matmul(at_points, a, precision=HIGHEST) for a in factor_derivatives]
    noise_terms = jax.vmap(noise_term, (None, 1, None), 1)
    total = 0.0
    for order, weight in enumerate(weights):
        shares = [(math.comb(order, i), i, order - i) for i in range(order + 1) if i < 3 and order - i < 3]
        product = sum(c * surface_values[i][:, None] * factor_values[j] for c, i, j in shares)
        noise = sum(c * noise_terms(surface_derivatives[i], factor_derivatives[j], variance) for c, i, j in shares)
        total = total + weight[:, None] * (product + jnp.matmul(at_points, noise, precision=HIGHEST))

    weight = standard.weights * weights[0]
    sums = jnp.matmul(weight, at_points, precision=HIGHEST)
    squares = jnp.matmul((weight[:, None] * factor_values[0]).T, factor_values[0], precision=HIGHEST)
    both = jax.vmap(jax.vmap(noise_term, (None, 1, None)), (1, None, None))(factors, factors, variance)
    jacobian = squares + jnp.matmul(both, sums, precision=HIGHEST)
    by_variance = jax.jacfwd(lambda v: noise_terms(surface, factors, v))(variance)
    return total, jacobian.at[:, -1].set(jnp.matmul(sums, by_variance, precision=HIGHEST))


def _line_weights(
    quadric: Quadric, variance: Float[Array, ""], points: Float[Array, "n 3"]
) -> list[Float[Array, " n"]]:
    """(-v)^m / m! (d/dL)^m g at every point for m = 0 to 4, or for 0 alone where L is constant.

    g = 1 / 4 (L^2 + l^2) is the imaginary part of 1 / (L - i l), over 4 l; a + i l b are the powers of that quotient.
    """
    if quadric.slope is None:
        return [jnp.broadcast_to(safe.divide(jnp.full_like(variance, 0.25), quadric.height**2), points.shape[:1])]
    line = jnp.matmul(points, quadric.slope, precision=HIGHEST) + quadric.height
    sq_smoothness = SMOOTHNESS**2 * variance * jnp.sum(quadric.slope**2)
    size = line * line + sq_smoothness + jnp.finfo(points.dtype).eps
    a, b = line / size, 1 / size
    weights = [b / 4]
    for _ in range(4):
        a, b = (a * line - sq_smoothness * b) / size, (a + b * line) / size
        weights.append(variance ** len(weights) * b / 4)
    return weights


def _mean_square(primitive: Primitive, standard: Standard) -> Float[Array, ""]:
    return jnp.sum(standard.weights * of(primitive).signed_distance(primitive, standard.local) ** 2)


def _inverse(jacobian: Float[Array, "q q"]) -> tuple[Float[Array, "q q"], Bool[Array, ""]]:
    """The inverse by singular values, at unit scale of the unknowns; those that rounding alone could leave are cut."""
    scale = safe.sqrt(jnp.abs(jnp.diagonal(jacobian)))
    shrink = jnp.where(scale > 0, 1 / jnp.where(scale > 0, scale, 1), 0)
    scaled = shrink[:, None] * jacobian * shrink[None, :]
    finite = jnp.all(jnp.isfinite(scaled))
    left, values, right = jnp.linalg.svd(jnp.where(finite, scaled, jnp.eye(len(scaled), dtype=scaled.dtype)))
    least = 100 * jnp.finfo(values.dtype).eps * values[0]
    inverse = jnp.matmul(right.T / jnp.maximum(values, least)[None, :], left.T, precision=HIGHEST)
    return shrink[:, None] * inverse * shrink[None, :], finite & (values[-1] > least)


def _propagated(inverse: Float[Array, "q q"], equations: _Equations) -> Float[Array, "q q"]:
    half = jnp.matmul(inverse, equations.covariance, precision=HIGHEST)
    return jnp.matmul(half, inverse.T, precision=HIGHEST)


def _localised(primitive: Primitive, standard: Standard) -> Primitive:
    turn = jnp.eye(3, dtype=standard.center.dtype)
    module = of(primitive)
    local = module.transform(primitive, turn, -standard.center / standard.scale, 1 / standard.scale)
    return module.canonical(local, jnp.zeros_like(standard.center))


def _globalised(primitive: Primitive, standard: Standard) -> Primitive:
    turn = jnp.eye(3, dtype=standard.center.dtype)
    return of(primitive).transform(primitive, turn, standard.center, standard.scale)
