"""Nonlinear least squares with few unknowns: Levenberg-Marquardt on a state that is moved by minimal steps.

The state is any pytree. It is never differentiated as such: retract_fn(state, step) moves it by a step of num_freedom
numbers with retract_fn(state, 0) = state, and the Jacobian J is the derivative of the residuals r with respect to the
step, at 0. So a unit vector needs two numbers, no constraint, and H = J^T W J has no null direction. Steps end where
the next one would gain nothing that shows; under vmap with the last item (Marquardt 1963; More 1978).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jprimfit.geometry import safe
from jprimfit.geometry.linalg import HIGHEST

State = Any  # a pytree of arrays

_FIRST_DAMPING = 1e-3
_MIN_DAMPING, _MAX_DAMPING = 1e-9, 1e9


class Solution(NamedTuple):
    """Where the steps ended. H and its eigenvalues are in the coordinates of the minimal step at that state."""

    state: State  # of the type that was passed in; never of higher cost than that one
    cost: Float[Array, ""]  # sum w r^2 / 2
    ok: Bool[Array, ""]  # finite, H regular, and a further step would not lower the cost noticeably
    hessian: Float[Array, "p p"]  # J^T W J; sigma^2 times its inverse estimates the covariance of the step


class _System(NamedTuple):
    """The problem, linearised at a state."""

    cost: Float[Array, ""]
    gradient: Float[Array, " p"]
    hessian: Float[Array, "p p"]


class _Carry(NamedTuple):
    state: State
    system: _System
    damping: Float[Array, ""]
    settled: Bool[Array, ""]
    iteration: Int[Array, ""]


def minimise(
    residual_fn: Callable[[State], Float[Array, " n"]],
    state: State,
    weights: Float[Array, " n"],
    *,
    retract_fn: Callable[[State, Float[Array, " p"]], State],
    num_freedom: int,
    num_steps: int = 20,
    scale: Float[Array, ""] | float = 1.0,
) -> Solution:
    """Lower sum w r(state)^2 / 2 by at most num_steps damped Gauss-Newton steps.

    A trial step solves (S H S + damping) y = -S g with S = diag(H)^(-1/2), so that the units of the unknowns do not
    matter. It is taken, and the damping divided by 10, if it lowers the cost; else the damping grows tenfold and the
    state stays. A Cholesky factor or a cost that is not finite counts as no progress, nothing is raised.

    residual_fn: state -> (n,), signed. weights: (n,), >= 0. scale: the size of the quantities that the residuals are
    differences of; residuals of a few units in its last place are rounding and do not count against ok.
    Not for reverse-mode differentiation; derivatives through the steps would not be those of the minimiser.
    """
    eps = jnp.finfo(weights.dtype).eps
    rounding = jnp.sum(weights) * (10 * eps * scale) ** 2

    def system_at(at: State) -> _System:
        return _linearise(residual_fn, at, weights, retract_fn=retract_fn, num_freedom=num_freedom)

    def step(carry: _Carry) -> _Carry:
        trial_step = -_damped_solve(carry.system, carry.damping)
        trial_step = jnp.where(jnp.all(jnp.isfinite(trial_step)), trial_step, 0)
        trial = retract_fn(carry.state, trial_step)
        trial_system = system_at(trial)
        better = (trial_system.cost < carry.system.cost) & jnp.all(jnp.isfinite(trial_system.hessian))
        state, system = _select(better, (trial, trial_system), (carry.state, carry.system))
        foreseen = -jnp.dot(carry.system.gradient, trial_step, precision=HIGHEST) / 2
        gain = jnp.where(better, carry.system.cost - trial_system.cost, foreseen)
        is_last = (carry.damping <= _FIRST_DAMPING) & (gain <= 10 * eps * system.cost + eps * rounding)
        damping = jnp.clip(carry.damping * jnp.where(better, 0.1, 10), _MIN_DAMPING, _MAX_DAMPING)
        return _Carry(state, system, damping.astype(carry.damping.dtype), is_last, carry.iteration + 1)

    def unfinished(carry: _Carry) -> Bool[Array, ""]:
        return ~carry.settled & (carry.iteration < num_steps)

    start = system_at(state)
    first = jnp.full((), _FIRST_DAMPING, start.cost.dtype)
    carry = _Carry(state, start, first, jnp.zeros((), bool), jnp.zeros((), jnp.int32))
    carry = jax.lax.while_loop(unfinished, step, carry)
    ok = _is_solved(carry.system, weights, scale)
    return Solution(carry.state, carry.system.cost, ok, carry.system.hessian)


def _linearise(residual_fn, state: State, weights, *, retract_fn, num_freedom: int) -> _System:
    def residual_of(step):
        residual = residual_fn(retract_fn(state, step))
        return residual, residual

    jacobian, residual = jax.jacfwd(residual_of, has_aux=True)(jnp.zeros(num_freedom, weights.dtype))
    weighted = weights[:, None] * jacobian
    return _System(
        cost=jnp.sum(weights * residual * residual) / 2,
        gradient=jnp.matmul(weighted.T, residual, precision=HIGHEST),
        hessian=jnp.matmul(weighted.T, jacobian, precision=HIGHEST),
    )


def _scaled(system: _System) -> tuple[Float[Array, " p"], Float[Array, "p p"]]:
    """S and S H S, whose diagonal is 1, or 0 for an unknown that moves no residual."""
    shrink = safe.divide(jnp.ones_like(system.gradient), safe.sqrt(jnp.diagonal(system.hessian)))
    return shrink, shrink[:, None] * system.hessian * shrink[None, :]


def _damped_solve(system: _System, damping: Float[Array, ""]) -> Float[Array, " p"]:
    shrink, hessian = _scaled(system)
    # The last term keeps the factor real where H is singular by rounding.
    floor = damping + 10 * jnp.finfo(hessian.dtype).eps
    factor = jnp.linalg.cholesky(hessian + floor * jnp.eye(hessian.shape[0], dtype=hessian.dtype))
    return shrink * jax.scipy.linalg.cho_solve((factor, True), (shrink * system.gradient)[:, None])[:, 0]


def _is_solved(system: _System, weights: Float[Array, " n"], scale: Float[Array, ""] | float) -> Bool[Array, ""]:
    eps = jnp.finfo(system.cost.dtype).eps
    _, hessian = _scaled(system)
    finite = jnp.isfinite(system.cost) & jnp.all(jnp.isfinite(hessian))
    regular = jnp.linalg.eigvalsh(jnp.where(finite, hessian, 0))[0] > 100 * eps
    # What a full Gauss-Newton step would gain, against the cost and against that of residuals which are rounding.
    gain = jnp.dot(system.gradient, _damped_solve(system, jnp.zeros_like(system.cost)), precision=HIGHEST) / 2
    rounding = jnp.sum(weights) * (10 * eps * scale) ** 2
    return finite & regular & (gain <= 1e-3 * system.cost + rounding)


def _select(condition: Bool[Array, ""], chosen: State, other: State) -> State:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), chosen, other)
