"""Standard errors: those of `fit_primitive`, those of textbooks, and infinity where the points do not tell."""

import numpy as np
import pytest

import jprimfit
from jprimfit.cad.uncertainty import standard_errors
from jprimfit.fitting.info import standard_errors as of_fit
from jprimfit.types import Cone, Cylinder, Plane, Sphere

AXIS = np.array([0.6, 0.0, 0.8])
CENTER = np.array([100.0, -20.0, 5.0])
SIGMA = 0.01


def _scan(kind, num_points=800):
    """Noisy points of a third of a turn, or of a cap, and the surface they are of."""
    random = np.random.default_rng(7)
    frame = np.stack([np.array([0.8, 0, -0.6]), np.array([0.0, 1, 0]), AXIS])
    angle, height = random.uniform(0, 2, num_points), random.uniform(1, 4, num_points)
    around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    upwards = np.array([[0, 0, 1.0]])
    if kind == "plane":
        local, truth = random.uniform(-1, 1, (num_points, 3)) * [3, 2, 0], Plane(AXIS, np.float64(AXIS @ CENTER))
    elif kind == "sphere":
        up = random.uniform(0.5, 1, num_points)[:, None]
        local, truth = 2 * (np.sqrt(1 - up**2) * around + up * upwards), Sphere(CENTER, np.float64(2))
    elif kind == "cylinder":
        local, truth = 2 * around + height[:, None] * upwards, Cylinder(AXIS, CENTER, np.float64(2))
    else:
        local = height[:, None] * (np.tan(0.4) * around + upwards)
        truth = Cone(AXIS, CENTER, np.float64(0.4))
    return local @ frame + CENTER + SIGMA * random.standard_normal((num_points, 3)), truth


@pytest.mark.parametrize("kind", ["plane", "sphere", "cylinder", "cone"])
def test_they_agree_with_those_of_the_fit(kind):
    points, _ = _scan(kind)
    primitive, info = jprimfit.fit_primitive(kind, points)
    found, expected = standard_errors(primitive, points), of_fit(primitive, info)
    assert found.keys() == expected.keys() and info.ok
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=0.08), name


def test_a_sphere_seen_all_round_has_the_textbook_errors():
    random = np.random.default_rng(0)
    normals = random.standard_normal((20_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = CENTER + (3 + SIGMA * random.standard_normal((20_000, 1))) * normals
    found = standard_errors(Sphere(CENTER, np.float64(3)), points)
    # J^T J is n/3 for each coordinate of the center, n for the radius.
    assert found["radius"] == pytest.approx(SIGMA / np.sqrt(20_000), rel=0.02)
    assert found["position"] == pytest.approx(3 * SIGMA / np.sqrt(20_000), rel=0.02)


@pytest.mark.parametrize("num_points", [0, 1, 5])
def test_too_few_points_tell_nothing(num_points):
    points = np.random.default_rng(0).normal(size=(num_points, 3))
    assert set(standard_errors(Cylinder(AXIS, CENTER, np.float64(2)), points).values()) == {np.inf}


def test_points_on_one_line_of_a_cylinder_tell_nothing():
    points = CENTER + 2 * np.array([0, 1, 0]) + np.linspace(0, 3, 50)[:, None] * AXIS
    assert standard_errors(Cylinder(AXIS, CENTER, np.float64(2)), points)["radius"] == np.inf
