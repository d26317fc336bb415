"""The likelihood of a whole cone: its derivatives, what it gains, and when it is not believed."""

import jax
import numpy as np
import pytest
from scipy import special

import jprimfit
from jprimfit.evaluation import patches
from jprimfit.fitting import full_cone, single
from jprimfit.fitting.info import sq_distance
from jprimfit.geometry.linalg import frame_of
from jprimfit.types import Cone

CONE = patches.WHOLE[3]


def log_density(model, points):
    """By a dense rule, with the constants."""
    x, y, z = full_cone._local(model, points)
    rho = np.hypot(x, y)[:, None]
    place, weight = np.polynomial.legendre.leggauss(300)
    slant = model.ends[0] + (model.ends[1] - model.ends[0]) * (place + 1) / 2
    r, h = slant * np.sin(model.half_angle), slant * np.cos(model.half_angle)
    distance = ((rho - r) ** 2 + (z[:, None] - h) ** 2) / (2 * model.sigma**2)
    terms = np.log(special.i0e(rho * r / model.sigma**2) * r * weight * (model.ends[1] - model.ends[0])) - distance
    area = np.sin(model.half_angle) * (model.ends[1] ** 2 - model.ends[0] ** 2)
    return special.logsumexp(terms, axis=1) - np.log(area) - 3 * np.log(model.sigma)


def test_scores_are_the_derivatives_of_the_log_density():
    rng = np.random.default_rng(0)
    axis = np.array([0.2, -0.3, 0.9]) / np.linalg.norm([0.2, -0.3, 0.9])
    with jax.enable_x64(True):
        frame = np.asarray(frame_of(jax.numpy.asarray(axis)))
    model = full_cone._Model(frame, np.array([0.1, 0.2, -0.1]), 4.0, 0.7, 0.3, (2.0, 7.0))
    points = 2.0 * rng.normal(size=(40, 3))
    scores = full_cone._scores(model, points)
    for unknown in range(9):
        step = 1e-5 * (np.arange(9) == unknown)
        ahead, behind = (log_density(full_cone._moved(model, sign * step), points) for sign in (1, -1))
        np.testing.assert_allclose(scores[:, unknown], (ahead - behind) / 2e-5, rtol=1e-4, atol=1e-4)


def errors(points):
    found, info = jprimfit.fit_primitive("cone", points)
    return info.method, np.abs(patches.fields(found, CONE.truth) - patches.fields(CONE.truth, CONE.truth)).sum()


@pytest.mark.slow
def test_it_is_used_for_an_even_cone_and_only_there():
    rng = np.random.default_rng(3)
    clean = CONE.draw(rng, 6000)
    points = clean + 0.6 * rng.normal(size=clean.shape)
    method, error = errors(points)
    assert method == "likelihood" and error < 0.4
    # Seen from one side, or twice as densely on one half: the density is not what the likelihood takes it for.
    assert errors(points[clean[:, 0] > 0])[0] == "unbiased"
    assert errors(np.concatenate([points, points[clean[:, 2] > 4]]))[0] == "unbiased"


def test_its_covariance_follows_the_frame_of_the_answer():
    # The frame of an axis near z jumps with its small components: tilts must be told along that of the answer.
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    axis = np.array([1e-3, 2e-3, 1.0]) / np.linalg.norm([1e-3, 2e-3, 1.0])
    with jax.enable_x64(True):
        own = np.asarray(frame_of(jax.numpy.asarray(axis)))
        turned = np.stack([own[1], -own[0], own[2]])
        likely = full_cone.FullCone(Cone(axis, -axis, np.float64(0.5)), 1.0, covariance, turned)
        np.testing.assert_allclose(np.diag(single._in_own_frame(likely)), [2, 1, 4, 3, 5, 6], atol=1e-12)


def test_its_covariance_is_that_of_the_errors():
    squares = []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        points = CONE.draw(rng, 1500)
        found, info = jprimfit.fit_primitive("cone", points + 0.5 * rng.normal(size=points.shape))
        if info.method == "likelihood":
            squares.append(sq_distance(found, info, CONE.truth))
    assert len(squares) > 15
    assert np.mean(squares) == pytest.approx(6, abs=4 * np.sqrt(12 / len(squares)))
