"""Faces that other faces cut: exact edges and corners, and none where surfaces meet smoothly."""

import numpy as np
import pytest

from jprimfit.cad import edges, patches
from jprimfit.types import Cylinder, Plane

X, Y, Z = np.eye(3)


def box(rng, num, *, noise=0.0):
    """Points on three sides of a box that share the corner (1, 1, 1), and their planes."""
    flat = rng.uniform(0, 1, (3, num, 2))
    ones = np.ones((num, 1))
    faces = [np.hstack([ones, flat[0]]), np.hstack([flat[1][:, :1], ones, flat[1][:, 1:]]), np.hstack([flat[2], ones])]
    points = np.concatenate(faces) + noise * rng.normal(size=(3 * num, 3))
    planes = tuple(Plane(normal, np.float64(1)) for normal in (X, Y, Z))
    return planes, points, np.repeat(np.arange(3, dtype=np.int32), num)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_faces_of_a_box_end_on_its_edges_and_in_its_corner(noise):
    planes, points, labels = box(np.random.default_rng(0), 600, noise=noise)
    found = patches.of_faces(planes, points, labels)
    for patch in found:
        assert patch.edge is not None and set(patch.edge.tolist()) == {-1, 0, 1}
        beyond = patch.vertices.max(axis=0) - 1
        assert beyond.max() < (1e-9 if noise == 0 else 0.01)  # no vertex beyond an edge
        corner = np.abs(patch.vertices - 1).max(axis=1)
        assert corner.min() < (1e-9 if noise == 0 else 0.03)
        a, b, c = (patch.vertices[patch.faces[:, i]] for i in range(3))
        assert np.sum(np.cross(b - a, c - a) * patch.normals[patch.faces[:, 0]], axis=1).min() >= -1e-15
    # The free sides end where the points do, a mean gap short or beyond; the area of each is that of a unit square.
    assert [patches.area(patch) for patch in found] == pytest.approx([1, 1, 1], abs=0.03)


def test_a_hole_smaller_than_the_gaps_that_are_closed_is_cut_by_its_wall():
    rng = np.random.default_rng(1)
    flat = rng.uniform(-1, 1, (2_000, 2))
    flat = flat[np.hypot(*flat.T) > 0.06]
    turn = rng.uniform(0, 2 * np.pi, 300)
    wall = np.stack([0.06 * np.cos(turn), 0.06 * np.sin(turn), rng.uniform(-0.5, 0, 300)], axis=1)
    points = np.concatenate([np.column_stack([flat, np.zeros(len(flat))]), wall])
    labels = np.repeat(np.arange(2, dtype=np.int32), [len(flat), 300])
    surfaces = (Plane(Z, np.float64(0)), Cylinder(Z, np.zeros(3), np.float64(0.06)))
    alone = patches.patch(surfaces[0], points[labels == 0])
    plate, hole = patches.of_faces(surfaces, points, labels)
    assert [len(patches.boundary_loops(one)) for one in (alone, plate, hole)] == [1, 2, 2]
    radius = np.hypot(*plate.vertices[:, :2].T)
    assert radius.min() == pytest.approx(0.06, abs=1e-9)
    assert hole.vertices[:, 2].max() == pytest.approx(0, abs=1e-9)


def test_where_surfaces_meet_smoothly_points_decide():
    # A quarter of a cylinder that a plane continues.
    rng = np.random.default_rng(2)
    turn = rng.uniform(0, np.pi / 2, 1_500)
    along = rng.uniform(0, 1, (2, 1_500))
    arc = np.stack([np.sin(turn), np.cos(turn), along[0]], axis=1)
    flat = np.stack([-rng.uniform(0, 1, 1_500), np.ones(1_500), along[1]], axis=1)
    labels = np.repeat(np.arange(2, dtype=np.int32), 1_500)
    surfaces = (Cylinder(Z, np.zeros(3), np.float64(1)), Plane(Y, np.float64(1)))
    points = np.concatenate([arc, flat])
    assert edges.cut(0, arc, edges.beside(surfaces, points, labels), within=0.2) is None
    for number, patch in enumerate(patches.of_faces(surfaces, points, labels)):
        assert patch.edge is None
        np.testing.assert_array_equal(
            patch.vertices, patches.patch(surfaces[number], points[labels == number]).vertices
        )


def test_a_step_in_a_floor_leaves_the_floor_whole_beside_its_corner():
    # A block on a floor: the floor has a reentrant corner, at which neither wall alone may cut it.
    rng = np.random.default_rng(3)
    floor = rng.uniform(-1, 1, (3_000, 2))
    floor = floor[~((floor > 0).all(axis=1))]
    side, height = rng.uniform(0, 1, (2, 700)), rng.uniform(0, 0.5, (2, 700))
    zero = np.zeros(700)
    points = np.concatenate(
        [
            np.column_stack([floor, np.zeros(len(floor))]),
            np.stack([zero, side[0], height[0]], axis=1),
            np.stack([side[1], zero, height[1]], axis=1),
        ]
    )
    labels = np.repeat(np.arange(3, dtype=np.int32), [len(floor), 700, 700])
    surfaces = (Plane(Z, np.float64(0)), Plane(X, np.float64(0)), Plane(Y, np.float64(0)))
    found = patches.of_faces(surfaces, points, labels)[0]
    assert patches.area(found) == pytest.approx(3, rel=0.02) and len(patches.boundary_loops(found)) == 1
    inner = found.vertices[(found.vertices[:, :2] > 1e-9).all(axis=1)]
    assert len(inner) == 0 or inner.min(axis=1).max() < 0.05


@pytest.mark.parametrize("labels", [np.full(50, -1, np.int32), np.zeros(50, np.int32)])
def test_one_face_has_nothing_beside_it(labels):
    points = np.random.default_rng(4).normal(size=(50, 3))
    assert edges.beside((), points, labels) is None
    assert edges.beside((), points[:3], labels[:3]) is None


def test_places_that_no_intersection_is_near_stay_away():
    planes = (Plane(Z, np.float64(0)), Plane(Z, np.float64(1)))
    places = np.random.default_rng(5).normal(size=(10, 3))
    assert not edges.intersection(planes, places, within=5.0)[1].any()
    moved, there = edges.intersection((Plane(Z, np.float64(0)), Plane(X, np.float64(2))), places, within=0.5)
    np.testing.assert_array_equal(there, np.hypot(places[:, 2], places[:, 0] - 2) <= 0.5)
    np.testing.assert_allclose(moved[:, 1], places[:, 1])


def test_a_strip_narrower_than_the_cells_is_not_missed():
    # A ring between two cylinders, as wide as the spacing of its few points.
    rng = np.random.default_rng(6)
    turn = rng.uniform(0, 2 * np.pi, 2_300)
    radius = np.concatenate([np.sqrt(rng.uniform(0.98**2, 1, 300)), np.ones(1_000), np.full(1_000, 0.98)])
    height = np.concatenate([np.zeros(300), rng.uniform(-0.15, 0, 1_000), rng.uniform(0, 0.15, 1_000)])
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    labels = np.repeat(np.arange(3, dtype=np.int32), [300, 1_000, 1_000])
    surfaces = (
        Plane(Z, np.float64(0)),
        Cylinder(Z, np.zeros(3), np.float64(1)),
        Cylinder(Z, np.zeros(3), np.float64(0.98)),
    )
    ring = patches.of_faces(surfaces, points, labels)[0]
    assert patches.area(ring) == pytest.approx(np.pi * (1 - 0.98**2), rel=0.01)
    assert len(patches.boundary_loops(ring)) == 2
