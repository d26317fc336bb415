"""Levenberg-Marquardt against closed forms and scipy, on states that know nothing of planes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from jprimfit.solvers.least_squares import minimise

RNG = np.random.default_rng(0)
ROWS, VALUES, WEIGHTS = RNG.normal(size=(12, 3)), RNG.normal(size=12), RNG.uniform(0.1, 1, 12)


def add(state, step):
    return state + step


def solve_linear(rows, values, weights, start):
    def residual(x):
        return jnp.matmul(rows, x) - values

    return minimise(residual, start, weights, retract_fn=add, num_freedom=3, num_steps=8)


def solve_decay(times, values, start):
    """Amplitude, rate and floor of a decaying exponential."""

    def residual(x):
        return x[0] * jnp.exp(-x[1] * times) + x[2] - values

    return minimise(residual, start, jnp.ones_like(times), retract_fn=add, num_freedom=3, num_steps=30)


def solve_direction(vectors, weights, start):
    """The unit vector most nearly perpendicular to all vectors, moved on the sphere by two tilts."""

    def residual(state):
        return jnp.matmul(vectors, state["direction"], precision="highest")

    def retract(state, step):
        direction = state["direction"]
        first = jnp.cross(direction, jnp.array([0.3, -0.5, 0.8], direction.dtype))
        moved = direction + step[0] * first + step[1] * jnp.cross(direction, first)
        return {"direction": moved / jnp.sqrt(jnp.sum(moved**2))}

    start = {"direction": start}
    return minimise(residual, start, weights, retract_fn=retract, num_freedom=2, num_steps=15)


def test_linear_problem_is_solved_like_lstsq(x64):
    solution = jax.jit(solve_linear)(*map(jnp.asarray, (ROWS, VALUES, WEIGHTS)), jnp.zeros(3))
    root = np.sqrt(WEIGHTS)
    expected = np.linalg.lstsq(ROWS * root[:, None], VALUES * root, rcond=None)[0]
    np.testing.assert_allclose(solution.state, expected, atol=1e-10)
    np.testing.assert_allclose(solution.hessian, (ROWS * WEIGHTS[:, None]).T @ ROWS, atol=1e-12)
    np.testing.assert_allclose(solution.cost, np.sum(WEIGHTS * (ROWS @ expected - VALUES) ** 2) / 2)
    assert solution.ok


def test_curved_problem_agrees_with_scipy(x64):
    times = np.linspace(0, 4, 25)
    values = 2.0 * np.exp(-1.3 * times) + 0.4 + 0.05 * np.random.default_rng(1).normal(size=25)
    expected = least_squares(lambda x: x[0] * np.exp(-x[1] * times) + x[2] - values, [1.0, 0.1, 0.0], xtol=1e-14)
    solution = jax.jit(solve_decay)(jnp.asarray(times), jnp.asarray(values), jnp.array([1.0, 0.1, 0.0]))
    np.testing.assert_allclose(solution.state, expected.x, atol=1e-6)
    np.testing.assert_allclose(solution.cost, expected.cost, rtol=1e-10)
    assert solution.ok


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_state_on_a_sphere_finds_the_smallest_eigenvector(x64, dtype):
    vectors = np.random.default_rng(2).normal(size=(30, 3)) * np.array([1.0, 0.8, 0.1])
    weights = np.random.default_rng(3).uniform(size=30)
    _, expected = np.linalg.eigh((vectors * weights[:, None]).T @ vectors)
    start = jnp.asarray(np.array([0.6, 0.0, 0.8]), dtype)
    solution = jax.jit(solve_direction)(jnp.asarray(vectors, dtype), jnp.asarray(weights, dtype), start)
    atol = {"float32": 1e-4, "float64": 1e-8}[dtype]  # of a minimum found through its cost: root of the rounding
    np.testing.assert_allclose(np.abs(expected[:, 0] @ np.asarray(solution.state["direction"])), 1, atol=atol**2 + 1e-7)
    np.testing.assert_allclose(np.abs(solution.state["direction"]), np.abs(expected[:, 0]), atol=atol)
    assert solution.ok and solution.state["direction"].dtype == dtype


def test_batch_jit_and_plain_agree(x64):
    starts = jnp.array([[0.0, 0.0, 0.0], [1.0, -1.0, 5.0]])
    problem = tuple(map(jnp.asarray, (ROWS, VALUES, WEIGHTS)))
    batch = jax.jit(jax.vmap(solve_linear, in_axes=(None, None, None, 0)))(*problem, starts)
    single = jax.jit(solve_linear)(*problem, starts[1])
    plain = solve_linear(*problem, starts[1])
    np.testing.assert_allclose(batch.state, np.broadcast_to(plain.state, (2, 3)), atol=1e-9)
    np.testing.assert_allclose(single.state, plain.state, atol=1e-12)
    np.testing.assert_array_equal(batch.ok, [True, True])


def test_rows_without_weight_do_not_count():
    weights = np.where(np.arange(12) < 9, WEIGHTS, 0)
    solve = jax.jit(solve_linear)
    arguments = [jnp.asarray(a, jnp.float32) for a in (ROWS, VALUES, weights, np.zeros(3))]
    wild = arguments[1].at[9:].set(1e6)
    np.testing.assert_array_equal(solve(*arguments).state, solve(arguments[0], wild, *arguments[2:]).state)


@pytest.mark.parametrize("case", ["no weight", "one row", "not finite"])
def test_undetermined_problems_stay_finite_and_say_so(case):
    rows, values, weights, start = (jnp.asarray(a, jnp.float32) for a in (ROWS, VALUES, WEIGHTS, np.ones(3)))
    if case == "no weight":
        weights = jnp.zeros_like(weights)
    if case == "one row":
        weights = weights * (jnp.arange(12) == 3)
    if case == "not finite":
        values = values.at[0].set(jnp.nan)
    solution = jax.jit(solve_linear)(rows, values, weights, start)
    assert not solution.ok
    assert np.all(np.isfinite(solution.state))


def test_cost_never_rises_and_too_few_steps_are_reported(x64):
    times = jnp.linspace(0, 4, 25)
    values = 2.0 * jnp.exp(-1.3 * times)

    def solve(num_steps):
        def residual(x):
            return x[0] * jnp.exp(-x[1] * times) - values

        return minimise(
            residual,
            jnp.array([-1.0, 0.1]),
            jnp.ones(25),
            retract_fn=add,
            num_freedom=2,
            num_steps=num_steps,
        )

    solutions = [jax.jit(solve, static_argnums=0)(steps) for steps in (0, 3, 30)]
    costs = [float(solution.cost) for solution in solutions]
    assert costs == sorted(costs, reverse=True) and costs[-1] < 1e-20
    assert [bool(solution.ok) for solution in solutions] == [False, False, True]
