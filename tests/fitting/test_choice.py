"""Kinds are chosen by what their points say beside the surfaces around them."""

import numpy as np
import pytest

from jprimfit.fitting import choice, local
from jprimfit.fitting.merging import Surface
from jprimfit.primitives.table import KINDS
from jprimfit.types import Cylinder, Plane, Sphere

RADIUS, HEIGHT, NOISE = 1.0, 0.6, 0.03
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def disc():
    """A low disc under noise, described: points and the labels of its rim (0), top (1) and bottom (2)."""
    rng = np.random.default_rng(0)
    turn, height = rng.uniform(0, 2 * np.pi, 4_000), rng.uniform(-HEIGHT / 2, HEIGHT / 2, 4_000)
    rim = np.column_stack([RADIUS * np.cos(turn), RADIUS * np.sin(turn), height])
    radius, turn = np.sqrt(rng.uniform(0, 1, 8_000)), rng.uniform(0, 2 * np.pi, 8_000)
    faces = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.repeat([HEIGHT / 2, -HEIGHT / 2], 4_000)])
    points = np.concatenate([rim, faces])
    points = points + NOISE * rng.normal(size=points.shape)
    return points, local.describe(points, noise=NOISE), np.repeat([0, 1, 2], 4_000)


def chosen(disc, rim, sought=KINDS):
    points, described, labels = disc
    surfaces = [
        Surface(np.flatnonzero(labels == number), primitive)
        for number, primitive in enumerate([rim, Plane(UP, HEIGHT / 2), Plane(UP, -HEIGHT / 2)])
    ]
    return choice.chosen(points, described, surfaces, labels, noise=NOISE, sought=sought)


def test_a_sphere_over_the_rim_of_a_disc_becomes_the_cylinder_that_it_is(disc):
    found = chosen(disc, Sphere(np.zeros(3), RADIUS + 0.01))
    rim = found[0].primitive
    assert isinstance(rim, Cylinder)
    assert rim.radius == pytest.approx(RADIUS, abs=0.01) and abs(rim.axis @ UP) > np.cos(np.radians(3.0))
    assert [one.primitive.kind for one in found[1:]] == ["plane", "plane"]


def test_what_is_right_stays(disc):
    cylinder = Cylinder(UP, np.zeros(3), RADIUS)
    assert [one.primitive.kind for one in chosen(disc, cylinder)] == ["cylinder", "plane", "plane"]


def test_kinds_that_are_not_sought_are_not_chosen(disc):
    ball = Sphere(np.zeros(3), RADIUS + 0.01)
    assert chosen(disc, ball, sought=("plane", "sphere"))[0].primitive.kind == "sphere"


def test_nothing_to_choose():
    points = np.random.default_rng(0).normal(size=(30, 3))
    assert choice.chosen(points, local.describe(points), [], np.full(30, -1), noise=0.1, sought=KINDS) == []
