"""The equations of a cylinder and a cone written out give what the general ones give."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jprimfit.evaluation import patches
from jprimfit.fitting import axial, kinds, segments, shapes
from jprimfit.primitives import estimation
from jprimfit.primitives.table import MODULES

general = jax.jit(estimation.estimate)
CASES = [
    ("cylinder", (-6.0, 6.0, 0.0, 6.28), 0.0),
    ("cylinder", (-6.0, 6.0, 0.0, 6.28), 0.05),
    ("cylinder", (-2.0, 6.0, 0.0, 1.5), 0.03),
    ("cylinder", (-6.0, 6.0, 0.5, 1.1), 0.005),
    ("cone", (1.0, 6.0, 0.0, 6.28), 0.0),
    ("cone", (0.0, 6.0, 0.0, 6.28), 0.05),
    ("cone", (0.0, 6.0, 0.0, 1.6), 0.03),
    ("cone", (4.0, 6.0, 0.0, 1.6), 0.002),
]


def drawn(kind, edges, noise, num=512):
    """A segment at unit scale with weights, turned anyhow, and a start beside its surface."""
    rng = np.random.default_rng(3)
    truth = patches.CYLINDER if kind == "cylinder" else patches.CONE
    points = patches.Patch("", truth, edges).draw(rng, num)
    points = points + 6.0 * noise * rng.normal(size=points.shape)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    given = segments.segment(points @ turn.T + 5.0, rng.uniform(0.5, 1.0, num))
    with jax.enable_x64(True):
        module = MODULES[kind]
        there = module.transform(jax.tree.map(jnp.asarray, truth), jnp.asarray(turn), jnp.full(3, 5.0), 1.0)
        local = kinds.move(there, -given.anchor / given.size, 1.0 / given.size)
        local = module.canonical(jax.tree.map(jnp.asarray, local), jnp.zeros(3))
        start = module.retract(local, jnp.asarray(0.01 * rng.normal(size=module.NUM_FREEDOM)))
        return given, type(truth)(*(np.asarray(field) for field in start))


@pytest.mark.parametrize(("kind", "edges", "noise"), CASES)
def test_the_same_as_the_general_equations(x64, kind, edges, noise):
    given, start = drawn(kind, edges, noise)
    expected = general(jax.tree.map(jnp.asarray, start), jnp.asarray(given.local), jnp.asarray(given.weights))
    found = axial.estimate(start, given.local, given.weights)
    assert bool(found.ok) and bool(expected.ok)
    assert not noise or found.num_iterations == expected.num_iterations
    for ours, theirs in zip(found.primitive, expected.primitive, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-9)
    np.testing.assert_allclose(found.sigma, expected.sigma, rtol=1e-6, atol=1e-9)
    covariance = np.asarray(expected.covariance)
    spread = np.sqrt(np.diagonal(covariance)) + 1e-12
    correlation = (found.covariance - covariance) / spread[:, None] / spread
    np.testing.assert_allclose(correlation, 0.0, atol=1e-6 if noise else 1.0)


@pytest.mark.parametrize(("kind", "edges", "noise"), [CASES[1], CASES[5]])
def test_sums_and_derivatives_are_those_of_the_general_equations(x64, kind, edges, noise):
    given, start = drawn(kind, edges, noise)
    start, weights, variance = shapes.canonical(start), given.weights / given.weights.sum(), 0.01
    standard = estimation.standardise(jnp.asarray(given.local), jnp.asarray(weights))
    expected = estimation._equations(jax.tree.map(jnp.asarray, start), jnp.asarray(variance), standard)
    state = axial._State(start, variance, np.zeros((0, 0)), np.inf, False, 0)
    coordinates = np.ascontiguousarray(np.asarray(standard.local).T)
    found = axial._sums(axial._shape(start), state, coordinates, weights, float(standard.count))
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-10 * float(np.abs(theirs).max()))


@pytest.mark.parametrize(("kind", "edges", "noise"), [CASES[2], CASES[6]])
def test_samples_first_and_the_same_in_the_end(kind, edges, noise):
    given, start = drawn(kind, edges, noise, num=40_000)
    found = axial.estimate(start, given.local, given.weights)
    again = axial.estimate(found.primitive, given.local, given.weights)
    assert found.ok and again.ok
    error = np.sqrt(np.diagonal(found.covariance)).min()
    assert max(np.abs(a - b).max() for a, b in zip(found.primitive, again.primitive, strict=True)) < error
    assert abs(float(found.sigma) * given.size / (6.0 * noise) - 1.0) < 0.03


@pytest.mark.parametrize("start", [patches.CYLINDER, patches.CONE])
def test_a_plane_is_neither(start):
    points = np.random.default_rng(0).normal(size=(300, 3)) * [1.0, 1.0, 0.0]
    given = segments.segment(points)
    found = axial.estimate(start, given.local, given.weights)
    assert np.isfinite(found.covariance).all() and all(np.isfinite(field).all() for field in found.primitive)
    assert not found.ok or np.linalg.norm(found.covariance) > 1.0
