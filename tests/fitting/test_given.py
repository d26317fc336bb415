"""Segments that somebody else drew keep their points and get the surface that describes them."""

import numpy as np
import pytest

from jprimfit.fitting.given import fit_segments

SIGMA = 0.004
NUM = 400


def box_of_four(noise=SIGMA):
    """A plane, a ball, half a pipe and a cone apart from each other, and a second face of the plane."""
    generator = np.random.default_rng(3)
    u, v = generator.uniform(0, 1, (2, NUM))
    angle = 2 * np.pi * u
    flat = np.stack([u, v, 0 * u], axis=1)
    ball = generator.normal(size=(NUM, 3))
    ball = 0.4 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [3.0, 0, 0]
    pipe = np.stack([0.3 * np.cos(angle / 2), 0.3 * np.sin(angle / 2) - 3.0, 1.5 * v], axis=1)
    height = 0.2 + v
    cone = np.stack([0.5 * height * np.cos(angle), 0.5 * height * np.sin(angle) + 3.0, height], axis=1)
    points = np.concatenate([flat, ball, pipe, cone, flat + [0.0, 5.0, 0.0]])
    labels = np.repeat([5, 2, 9, 4, 7], NUM)
    return points + noise * generator.normal(size=points.shape), labels


def test_kinds_parameters_and_numbers():
    points, labels = box_of_four()
    found = fit_segments(points, labels)
    assert [primitive.kind for primitive in found.primitives] == ["sphere", "cone", "plane", "plane", "cylinder"]
    np.testing.assert_array_equal(found.labels, np.searchsorted([2, 4, 5, 7, 9], labels))
    sphere, cone, plane, _, cylinder = found.primitives
    np.testing.assert_allclose(sphere.radius, 0.4, atol=0.002)
    np.testing.assert_allclose(cone.half_angle, np.arctan(0.5), atol=0.005)
    np.testing.assert_allclose(np.abs(plane.normal[2]), 1.0, atol=1e-4)
    np.testing.assert_allclose(cylinder.radius, 0.3, atol=0.002)
    assert found.surface_of[2] == found.surface_of[3] and len(set(found.surface_of.tolist())) == 4
    assert found.noise == pytest.approx(SIGMA, rel=0.3)
    np.testing.assert_allclose(np.nanmean(found.distances), SIGMA * np.sqrt(2 / np.pi), rtol=0.1)


def test_points_far_off_their_segment_stay_in_it_and_do_not_bend_it():
    points, labels = box_of_four()
    points[NUM : NUM + 20] += [0.0, 0.0, 0.4]  # of the ball
    found = fit_segments(points, labels)
    assert found.primitives[0].kind == "sphere"
    np.testing.assert_allclose(found.primitives[0].radius, 0.4, atol=0.003)
    assert (found.labels[NUM : NUM + 20] == 0).all()


def test_kinds_may_be_told_or_narrowed():
    points, labels = box_of_four()
    found = fit_segments(points, labels, kind_of={9: "plane"})
    assert found.primitives[4].kind == "plane" and found.primitives[0].kind == "sphere"
    found = fit_segments(points, labels, sought=("plane", "cylinder"))
    assert {primitive.kind for primitive in found.primitives} == {"plane", "cylinder"}


def test_what_determines_nothing_becomes_none():
    points, labels = box_of_four()
    labels[labels == 2] = -1
    labels[:3] = 11  # two points and their neighbour
    points[:3] = points[0]
    found = fit_segments(points, labels)
    assert (found.labels[:3] == -1).all() and (found.labels[NUM : 2 * NUM] == -1).all()
    assert len(found.primitives) == 4 and found.labels.max() == 3
