"""Efficient RANSAC: what CGAL writes is read rightly, its answer belongs to the points, a crash is no answer."""

import os

import numpy as np
import pytest

from jprimfit.evaluation import answers, ransac
from jprimfit.types import Cone, Cylinder, Plane, Sphere

pytest.importorskip("CGAL")


def near(one, other):
    assert type(one) is type(other)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_lines_of_cgal():
    up = np.array([0.0, 0.0, 1.0])
    # The plane z = 0.7: the sign before the number is not to be believed.
    near(ransac.parse("Type: plane (0, 0, 1)x - -0.7= 0 #Pts: 3000"), Plane(up, np.float64(0.7)))
    near(ransac.parse("Type: plane (-0, 0, -2)x - -1.3= 0 #Pts: 30"), Plane(-up, np.float64(0.65)))
    words = "Type: cylinder center: (5.5e-17, -1e-16, 1.76) axis: (0, 0, -1) radius:0.5 #Pts: 3000"
    near(ransac.parse(words), Cylinder(-up, np.array([0, 0, 1.76]), np.float64(0.5)))
    words = "Type: cone apex: (0, 3, -1.28e-14) axis: (-0, -0, 1) angle:0.5 #Pts: 2000"
    near(ransac.parse(words), Cone(up, np.array([0.0, 3, 0]), np.float64(0.5)))
    ball = Sphere(np.array([3.0, 0, 5]), np.float64(0.4))
    near(ransac.parse("Type: sphere center: (3, 2e-17, 5) radius:0.4 #Pts: 20"), ball)
    with pytest.raises(ValueError, match="none of the four kinds"):
        ransac.parse("Type: torus center(0, 0, 0) axis(0, 0, 1) major radius=1 minor radius=0.2 #Pts: 7")


def two_surfaces():
    draw = np.random.default_rng(0)
    ball = draw.normal(size=(1500, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    floor = np.append(draw.uniform(-1, 1, (1500, 2)), np.full((1500, 1), 0.7), axis=1)
    return np.concatenate([0.4 * ball + [3, 0, 1], floor])


def test_a_floor_and_a_ball():
    points = two_surfaces()
    with ransac.Detector() as detect:
        found = detect(points, ransac.SETTINGS["default"])
        refitted = answers.ransac_scene(detect, ransac.SETTINGS["default"], points, refit=True)
    ball, floor = (int(np.bincount(rows + 1).argmax()) - 1 for rows in (found.labels[:1500], found.labels[1500:]))
    assert np.mean(found.labels == np.repeat([ball, floor], 1500)) > 0.95
    assert (found.primitives[ball].kind, found.primitives[floor].kind) == ("sphere", "plane")
    # From few points that lie within epsilon, drawn without a seed, so no nearer than that.
    epsilon = ransac.SETTINGS["default"].epsilon * np.linalg.norm(np.ptp(points, axis=0))
    assert found.primitives[floor].offset * found.primitives[floor].normal[2] == pytest.approx(0.7, abs=epsilon)
    assert found.primitives[ball].radius == pytest.approx(0.4, abs=epsilon) and found.seconds > 0
    sphere = next(p for p in refitted.primitives if p.kind == "sphere")
    assert sphere.radius == pytest.approx(0.4, abs=1e-3)


def test_a_crash_is_no_answer_and_the_next_cloud_has_one(monkeypatch):
    told = []
    points = two_surfaces()
    with ransac.Detector(told.append) as detect:
        with monkeypatch.context() as patch:
            patch.setattr(ransac, "_detect", _die)
            found = detect(points)
        assert found.primitives == () and np.all(found.labels == -1)
        assert told == ["CGAL crashed on a cloud of 3000 points, which counts as no answer."]
        assert detect(points).primitives


def _die(*_):
    os._exit(1)


def test_without_the_library_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'jprimfit\[baselines\]'"):
        ransac.Detector()
