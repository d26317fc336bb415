"""What a fit says of itself: coordinates of its covariance, standard errors, and how far another surface is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jprimfit
from jprimfit.evaluation import patches
from jprimfit.fitting import info as infos
from jprimfit.fitting.info import Info, semidefinite, sq_distance, standard_errors, step_between
from jprimfit.primitives import cone
from jprimfit.types import Cone

ANCHOR = np.array([1.0, 2.0, 3.0])


def test_steps_lead_from_one_primitive_to_the_other_and_back():
    for patch in patches.WHOLE:
        np.testing.assert_allclose(step_between(patch.truth, patch.truth, ANCHOR), 0, atol=1e-12)
    sphere = patches.SPHERE._replace(radius=np.float64(6.5))
    np.testing.assert_allclose(step_between(patches.SPHERE, sphere, ANCHOR), [0, 0, 0, 0.5], atol=1e-9)
    np.testing.assert_allclose(step_between(sphere, patches.SPHERE, ANCHOR), [0, 0, 0, -0.5], atol=1e-9)


@pytest.mark.parametrize("truth", [patches.PLANE, patches.CYLINDER])
def test_the_sign_of_an_axis_says_nothing(truth):
    turned = infos._turned_alike(type(truth)(-truth[0], *truth[1:]), truth)
    np.testing.assert_array_equal(turned[0], -truth[0])
    np.testing.assert_allclose(step_between(truth, turned, np.zeros(3)), 0, atol=1e-12)


def test_the_graph_of_a_cone_is_its_height_and_the_derivatives_of_that(x64):
    like = Cone(jnp.array([0.0, 0.6, 0.8]), jnp.array([0.5, -1.0, -2.0]), jnp.asarray(0.6))
    other = cone.retract(like, jnp.array([0.05, -0.08, 0.1, 0.02, -0.07, 0.06]))
    foot, plane = cone._tangent_plane(like)
    assert abs(cone.signed_distance(like, foot[None])[0]) < 1e-12

    def height(g: float, t: float) -> float:
        """By bisection along the normal."""
        low, high = -0.5, 0.5
        for _ in range(60):
            middle = (low + high) / 2
            at = foot + jnp.array([g, t, middle]) @ plane
            low, high = (middle, high) if cone.signed_distance(other, at[None])[0] < 0 else (low, middle)
        return (low + high) / 2

    step = 1e-2
    grid = np.array([[height(g * step, t * step) for t in (-1, 0, 1)] for g in (-1, 0, 1)])
    curved = (grid[:, 2] - 2 * grid[:, 1] + grid[:, 0]) / step**2
    expected = [
        grid[1, 1],
        (grid[2, 1] - grid[0, 1]) / (2 * step),
        (grid[1, 2] - grid[1, 0]) / (2 * step),
        curved[1],
        (grid[2, 2] - grid[2, 0] - grid[0, 2] + grid[0, 0]) / (4 * step**2),
        (curved[2] - curved[0]) / (2 * step),
    ]
    np.testing.assert_allclose(cone.graph(other, like), expected, rtol=2e-3, atol=2e-4)
    np.testing.assert_allclose(cone.graph(like, like)[:3], 0, atol=1e-12)


def test_errors_of_a_cone_are_those_of_its_axis_apex_and_half_angle():
    rng = np.random.default_rng(0)
    local = Cone(np.array([0.0, 0.6, 0.8]), np.array([0.5, -1.0, -2.0]), np.float64(0.6))
    size, half = 40.0, 1e-3 * rng.normal(size=(6, 6))
    with jax.enable_x64(True):
        at = jax.tree.map(jnp.asarray, local)
        told = infos.reported(at, half @ half.T)
        steps = rng.normal(size=(4000, 6)) @ half.T
        moved = jax.tree.map(np.asarray, jax.vmap(lambda step: cone.retract(at, step))(jnp.asarray(steps)))
    powers = size ** np.asarray(cone.GRAPH_UNITS, float)
    info = Info(True, 0.0, 0.0, powers[:, None] * told * powers, ANCHOR, 0, "unbiased")
    found = standard_errors(local._replace(apex=ANCHOR + size * local.apex), info)
    assert found["half_angle"] == pytest.approx(np.std(moved.half_angle), rel=0.1)
    assert found["position"] == pytest.approx(size * np.sqrt(np.var(moved.apex, axis=0).sum()), rel=0.1)
    assert found["direction"] == pytest.approx(np.sqrt(np.var(moved.axis, axis=0).sum()), rel=0.1)
    unknown = info._replace(covariance=np.full((6, 6), np.inf))
    assert set(standard_errors(local, unknown).values()) == {np.inf} and sq_distance(local, unknown, local) == np.inf


def test_regions_of_a_quarter_of_a_cone_hold_it():
    # Ties between axis, apex and half-angle bend a region told in them: 12 of 24 were outside, 1.2 are expected.
    outside = 0
    for seed in range(24):
        rng = np.random.default_rng(seed)
        points = patches.QUARTERS[3].draw(rng, 1000)
        found, info = jprimfit.fit_primitive("cone", points + 0.3 * rng.normal(size=points.shape))
        assert info.ok
        outside += sq_distance(found, info, patches.CONE) > 12.59
    assert outside <= 6


def test_rounding_leaves_no_negative_variance():
    rng = np.random.default_rng(0)
    half = rng.normal(size=(5, 3)) * 10.0 ** rng.uniform(-8, 8, (5, 1))
    covariance = half @ half.T
    spoilt = covariance * (1 + 1e-6 * rng.normal(size=(5, 5)))
    mended = semidefinite(spoilt)
    unit = 1 / np.sqrt(np.diagonal(covariance))
    assert np.linalg.eigvalsh(unit[:, None] * (spoilt + spoilt.T) / 2 * unit)[0] < -1e-9
    assert np.linalg.eigvalsh(unit[:, None] * mended * unit)[0] > -1e-14
    np.testing.assert_allclose(mended * unit * unit[:, None], covariance * unit * unit[:, None], atol=1e-5)
