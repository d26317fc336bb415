"""Noise has the direction and the spread that its kind promises."""

import numpy as np
import pytest

from jprimfit.data.noise import perturb, sigma_of_percent

POINTS = np.random.default_rng(0).normal(size=(20_000, 3))
NORMALS = POINTS / np.sqrt(np.sum(POINTS**2, axis=1))[:, None]


def test_uniform_moves_along_the_normal():
    offset = perturb(np.random.default_rng(1), POINTS, NORMALS, kind="uniform", amount=0.01) - POINTS
    along = np.sum(offset * NORMALS, axis=1)
    np.testing.assert_allclose(offset, along[:, None] * NORMALS, atol=1e-12)
    assert np.abs(along).max() <= 0.01 and np.abs(along).max() > 0.00999
    assert along.mean() == pytest.approx(0.0, abs=4 * 0.01 / np.sqrt(3 * 20_000))
    assert along.std() == pytest.approx(0.01 / np.sqrt(3), rel=0.02)


def test_gaussian_is_isotropic():
    offset = perturb(np.random.default_rng(2), POINTS, NORMALS, kind="gaussian", amount=0.02) - POINTS
    np.testing.assert_allclose(np.cov(offset.T), 4e-4 * np.eye(3), atol=2e-5)
    np.testing.assert_allclose(offset.mean(axis=0), 0.0, atol=4 * 0.02 / np.sqrt(20_000))


@pytest.mark.parametrize("kind", ["uniform", "gaussian"])
def test_nothing_moves_by_nothing(kind):
    np.testing.assert_array_equal(perturb(np.random.default_rng(0), POINTS, NORMALS, kind=kind, amount=0.0), POINTS)


def test_per_cent_of_the_diagonal():
    box = np.array([[1.0, 2.0, 3.0], [4.0, 6.0, 15.0]])  # sides 3, 4, 12: diagonal 13
    assert sigma_of_percent(box, 2.0) == pytest.approx(0.26)
    assert sigma_of_percent(box, 0.0) == 0.0


def test_what_makes_no_sense_is_named():
    with pytest.raises(ValueError, match="salt"):
        perturb(np.random.default_rng(0), POINTS, NORMALS, kind="salt", amount=0.1)
    with pytest.raises(ValueError, match="-0.1"):
        perturb(np.random.default_rng(0), POINTS, NORMALS, kind="uniform", amount=-0.1)
    with pytest.raises(ValueError, match="per cent"):
        sigma_of_percent(POINTS, float("nan"))
