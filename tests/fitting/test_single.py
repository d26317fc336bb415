"""`jprimfit.fit_primitive`: found without normals, free of bias, the same in any frame, and honest about bad input."""

import jax
import numpy as np
import pytest

import jprimfit
from jprimfit.evaluation import patches
from jprimfit.fitting import kinds
from jprimfit.fitting.info import sq_distance, standard_errors
from jprimfit.primitives.table import KINDS, MODULES

each_kind = pytest.mark.parametrize("kind", KINDS)
PARTS = {
    "plane": patches.WHOLE[0],
    "sphere": patches.PARTIAL[0],
    "cylinder": patches.PARTIAL[1],
    "cone": patches.Patch("cone", patches.CONE, (2.0, 6.0, 0.0, 3.0)),
}


def drawn(kind, *, sigma, seed=0, num_points=800):
    patch, rng = PARTS[kind], np.random.default_rng(seed)
    clean = patch.draw(rng, num_points)
    return clean + sigma * patch.unit * rng.normal(size=clean.shape)


def distance(kind, found):
    """Sum of the errors of all parameters."""
    truth = PARTS[kind].truth
    return np.abs(patches.fields(found, truth) - patches.fields(truth, truth)).sum()


@each_kind
@pytest.mark.parametrize("with_normals", [False, True])
def test_clean_points_give_the_surface(kind, with_normals):
    points, patch = drawn(kind, sigma=0.0), PARTS[kind]
    normals = None
    if with_normals:
        with jax.enable_x64(True):
            truth = jax.tree.map(jax.numpy.asarray, patch.truth)
            normals = -7.0 * np.asarray(MODULES[kind].normal(truth, jax.numpy.asarray(points)))
    found, info = jprimfit.fit_primitive(kind, points, normals=normals)
    assert info.ok and distance(kind, found) < 1e-9 * 6
    assert info.sigma < 1e-6 and info.rms < 1e-9
    assert found.kind == kind and all(np.asarray(field).dtype == np.float64 for field in found)


@each_kind
def test_noise_is_known_and_the_error_within_it(kind):
    found, info = jprimfit.fit_primitive(kind, drawn(kind, sigma=0.02))
    assert info.ok and info.sigma == pytest.approx(0.02 * PARTS[kind].unit, rel=0.1)
    assert sq_distance(found, info, PARTS[kind].truth) < 25
    errors = standard_errors(found, info)
    assert all(0 < value < 1 for value in errors.values())


def test_least_squares_is_biased_by_the_known_law_and_the_estimate_is_not():
    radii = {"unbiased": [], "least-squares": []}
    for seed in range(20):
        rng = np.random.default_rng(seed)
        clean = patches.WHOLE[1].draw(rng, 2000)
        points = clean + 0.6 * rng.normal(size=clean.shape)
        for method, found in radii.items():
            found.append(float(jprimfit.fit_primitive("sphere", points, method=method)[0].radius))
    error = np.std(radii["unbiased"]) / np.sqrt(20)
    assert np.mean(radii["unbiased"]) == pytest.approx(6, abs=4 * error)
    assert np.mean(radii["least-squares"]) == pytest.approx(6 + 0.6**2 / 6, abs=4 * error)


@each_kind
@pytest.mark.parametrize("shift,scale", [(1e6, 1.0), (0.0, 1e-6), (-3e4, 1e3)])
def test_the_frame_and_the_unit_do_not_matter(kind, shift, scale):
    points, offset = drawn(kind, sigma=0.01), shift * np.array([1.0, -0.5, 0.3])
    here, _ = jprimfit.fit_primitive(kind, points)
    there, info = jprimfit.fit_primitive(kind, scale * points + offset)
    assert info.ok
    back = kinds.move(there, -offset / scale, 1.0 / scale)
    for a, b in zip(here, back, strict=True):
        np.testing.assert_allclose(b, a, atol=1e-6 * 6)


@each_kind
def test_outliers_are_left_out_when_asked(kind):
    points = drawn(kind, sigma=0.01)
    rng = np.random.default_rng(5)
    points[:40] = rng.uniform(points.min(axis=0) - 1, points.max(axis=0) + 1, (40, 3))
    trusting, _ = jprimfit.fit_primitive(kind, points)
    wary, info = jprimfit.fit_primitive(kind, points, robust=True)
    assert info.ok and distance(kind, wary) < distance(kind, trusting)
    assert info.sigma == pytest.approx(0.01 * PARTS[kind].unit, rel=0.2)


def test_weights_choose_the_points():
    points = drawn("cylinder", sigma=0.01)
    alone, _ = jprimfit.fit_primitive("cylinder", points[::2])
    weights = np.zeros(len(points))
    weights[::2] = 3.0
    chosen, _ = jprimfit.fit_primitive("cylinder", points, weights)
    for a, b in zip(alone, chosen, strict=True):
        np.testing.assert_allclose(b, a, atol=1e-9)


@each_kind
@pytest.mark.parametrize("weights", [[0.0] * 30, None])
def test_what_has_no_shape_is_not_ok_but_finite(kind, weights):
    found, info = jprimfit.fit_primitive(kind, np.full((30, 3), [1.0, 2, 3]), weights)
    assert not info.ok and all(np.all(np.isfinite(field)) for field in found)


def test_a_sliver_says_that_it_knows_little():
    patch = patches.Patch("sliver", patches.CONE, (5.5, 6.0, 0.0, 0.1))
    points = patch.draw(np.random.default_rng(0), 300) + 0.01 * np.random.default_rng(1).normal(size=(300, 3))
    found, info = jprimfit.fit_primitive("cone", points)
    assert not info.ok or standard_errors(found, info)["position"] > 1
    assert all(np.all(np.isfinite(field)) for field in found)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("torus", np.zeros((9, 3))), "unknown kind of primitive 'torus'"),
        (("plane", np.zeros((9, 2))), "points has shape (9, 2)"),
        (("plane", np.zeros((0, 3))), "points has no rows"),
        (("plane", [["a", "b", "c"]]), "points has shape (1, 3) and type"),
        (("plane", np.full((9, 3), np.nan)), "points holds NaN"),
        (("plane", np.ones((9, 3)), np.ones(8)), "weights has 8 values and points 9 rows"),
        (("plane", np.ones((9, 3)), -np.ones(9)), "weights holds -1"),
        (("plane", np.ones((9, 3)), None, np.ones((8, 3))), "normals has 8 rows and points 9"),
    ],
)
def test_bad_arguments_are_named(arguments, words):
    with pytest.raises(ValueError, match="^[^\n]*$") as error:
        jprimfit.fit_primitive(*arguments)
    assert words in str(error.value)


def test_methods_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="unknown method 'median'"):
        jprimfit.fit_primitive("plane", np.ones((9, 3)), method="median")
    with pytest.raises(ValueError, match="not defined for a cone"):
        jprimfit.fit_primitive("cone", np.ones((9, 3)), method="minimum-zone")
