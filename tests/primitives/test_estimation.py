"""Estimates free of bias: exact where points are, honest about their spread, finite where nothing can be told."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy import stats

from jprimfit.evaluation.patches import CONE, CYLINDER, PLANE, SPHERE, Patch
from jprimfit.fitting import kinds
from jprimfit.fitting.info import reported, step_between
from jprimfit.primitives import estimation
from jprimfit.primitives.estimation import estimate
from jprimfit.primitives.table import KINDS, MODULES
from jprimfit.types import Cone, Cylinder, Plane, Sphere

PATCHES = {
    "plane": Patch("plane", PLANE, (-1.0, 1.0, -0.5, 0.5)),
    "sphere": Patch("sphere", SPHERE, (0.2, 1.0, 0.0, 4.0)),
    "cylinder": Patch("cylinder", CYLINDER, (-6.0, 6.0, 0.0, 1.5)),
    "cone": Patch("cone", CONE, (2.0, 6.0, 0.0, 2.0)),
}
each_kind = pytest.mark.parametrize("kind", KINDS)
solve = jax.jit(estimate)


def drawn(kind, *, sigma, seed=0, num_points=512):
    """The truth, points of a part of it with noise of sigma (in parts of its unit), and uneven weights."""
    patch, rng = PATCHES[kind], np.random.default_rng(seed)
    clean = patch.draw(rng, num_points)
    points = clean + sigma * patch.unit * rng.normal(size=clean.shape)
    return jax.tree.map(jnp.asarray, patch.truth), jnp.asarray(points), jnp.asarray(rng.uniform(0.5, 1, num_points))


def nearby(kind, truth, amount=0.03):
    module = MODULES[kind]
    step = amount * np.linspace(-1, 1, module.NUM_FREEDOM) * np.where(np.array(module.STEP_UNITS), 6.0, 1.0)
    return module.retract(truth, jnp.asarray(step))


@each_kind
def test_clean_points_give_the_surface_back(x64, kind):
    truth, points, weights = drawn(kind, sigma=0.0)
    found = solve(nearby(kind, truth), points, weights)
    assert found.ok
    step = step_between(PATCHES[kind].truth, jax.tree.map(np.asarray, found.primitive), np.asarray(points).mean(0))
    assert np.abs(step).max() < 1e-9
    assert found.sigma < 1e-6


@each_kind
def test_errors_are_distributed_as_the_covariance_says(x64, kind):
    # The squared distance from the truth in units of the covariance is chi-squared with p degrees of freedom.
    found = []
    for seed in range(60):
        truth, points, weights = drawn(kind, sigma=0.04, seed=seed)
        answer = solve(nearby(kind, truth, 0.01), points, weights)
        assert answer.ok
        anchor = np.average(np.asarray(points), axis=0, weights=np.asarray(weights))
        primitive = jax.tree.map(np.asarray, answer.primitive)
        covariance = reported(kinds.move(primitive, -anchor, 1.0), np.asarray(answer.covariance))
        back = step_between(primitive, PATCHES[kind].truth, anchor)
        found.append(back @ np.linalg.solve(covariance, back))
        assert float(answer.sigma) == pytest.approx(0.04 * PATCHES[kind].unit, rel=0.15)
    degrees = MODULES[kind].NUM_FREEDOM
    assert np.mean(found) == pytest.approx(degrees, abs=4 * np.sqrt(2 * degrees / len(found)))
    assert stats.kstest(found, stats.chi2(degrees).cdf).pvalue > 1e-3


@pytest.mark.slow  # compiles for minutes
@each_kind
def test_derivatives_are_those_of_the_solution(x64, kind, monkeypatch):
    # Finite differences see what iterations leave: the derivatives of the steps are expected ones, so they shrink
    # by a factor at a time, not by their square.
    monkeypatch.setattr(estimation, "CONVERGED", 1e-12)
    monkeypatch.setattr(estimation, "MAX_ITERATIONS", 100)
    truth, points, weights = drawn(kind, sigma=0.02, num_points=64)
    start = nearby(kind, truth, 0.01)

    @jax.jit
    def answer(points, weights):
        found = estimate(start, points, weights)
        return found.primitive, found.sigma

    check_grads(answer, (points, weights), order=1, modes=["rev"], atol=1e-4, rtol=1e-4, eps=1e-5)


@each_kind
def test_one_precision_agrees_with_the_other(x64, kind):
    truth, points, weights = drawn(kind, sigma=0.02)
    exact = solve(nearby(kind, truth), points, weights)
    single = jax.tree.map(lambda field: field.astype(jnp.float32), (nearby(kind, truth), points, weights))
    rounded = solve(*single)
    assert rounded.ok
    for a, b in zip(exact.primitive, rounded.primitive, strict=True):
        np.testing.assert_allclose(b, a, atol=2e-3)
    np.testing.assert_allclose(rounded.sigma, exact.sigma, rtol=1e-3)


@pytest.mark.slow  # compiles for minutes
@each_kind
def test_slots_under_vmap_are_those_of_single_calls(kind):
    truth, points, weights = (jax.tree.map(lambda field: field.astype(jnp.float32), x) for x in drawn(kind, sigma=0.02))
    columns = jnp.stack([weights, weights * (points[:, 0] > 0), jnp.zeros_like(weights)])
    start = nearby(kind, truth, 0.01)
    stacked = jax.jit(jax.vmap(functools.partial(estimate), (None, None, 0)))(start, points, columns)
    for slot, column in enumerate(columns):
        single = solve(start, points, column)
        assert bool(single.ok) == bool(stacked.ok[slot])
        for a, b in zip(single.primitive, stacked.primitive, strict=True):
            np.testing.assert_allclose(b[slot], a, rtol=1e-3, atol=1e-3)
    assert not stacked.ok[2]


def plate(rng, num_points):
    return np.append(rng.uniform(-1, 1, (num_points, 2)), 1e-3 * rng.normal(size=(num_points, 1)), axis=1)


DEGENERATE = {
    "no points of weight": lambda rng: rng.normal(size=(40, 3)),
    "one place": lambda rng: np.full((40, 3), 3.0),
    "a line": lambda rng: np.outer(rng.normal(size=40), [1.0, 2, 3]),
    "six points": lambda rng: rng.normal(size=(40, 3)),
    "a plate": lambda rng: plate(rng, 40),
    "a blob": lambda rng: rng.normal(size=(40, 3)),
}
COUNTED = {"no points of weight": 0, "six points": 6}
STARTS = {
    "plane": Plane(jnp.array([0.0, 0, 1]), jnp.array(0.1)),
    "sphere": Sphere(jnp.array([0.0, 0, 5]), jnp.array(5.0)),
    "cylinder": Cylinder(jnp.array([1.0, 0, 0]), jnp.array([0.0, 0, 5]), jnp.array(5.0)),
    "cone": Cone(jnp.array([0.0, 0, 1]), jnp.array([0.0, 0, -1]), jnp.array(1.4)),
}


@each_kind
def test_what_determines_nothing_is_finite_and_says_so(kind):
    def total(points, weights):
        found = estimate(STARTS[kind], points, weights)
        return sum(jnp.sum(field) for field in found.primitive), found

    slope = jax.jit(jax.grad(total, argnums=(0, 1), has_aux=True))
    for name, make in DEGENERATE.items():
        points = jnp.asarray(make(np.random.default_rng(0)), jnp.float32)
        weights = jnp.asarray(np.arange(40) < COUNTED.get(name, 40), jnp.float32)
        slopes, found = slope(points, weights)
        for leaf in jax.tree.leaves((found, slopes)):
            assert np.all(np.isfinite(leaf)), name
        if name in ("no points of weight", "one place"):
            assert not found.ok, name
