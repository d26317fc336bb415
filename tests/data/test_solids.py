"""Booleans that know their surfaces: exact areas, provenance, corners on all surfaces that meet."""

import numpy as np
import pytest

from jprimfit.data import shapes, solids
from jprimfit.types import Cone, Cylinder, Plane, Sphere


def areas_by_surface(body):
    doubled = solids.doubled_areas(body.vertices[body.faces])
    sizes = np.bincount(body.surface_index, weights=np.sqrt(np.sum(doubled**2, axis=1)) / 2)
    return [(surface and surface.kind, size) for surface, size in zip(body.surfaces, sizes, strict=True)]


def test_a_block_with_a_hole_has_the_areas_of_the_formula():
    block = solids.difference(shapes.box((2, 1, 0.5)), shapes.cylinder(0.3, 2, (0, 0, -1)))
    found = areas_by_surface(solids.evaluate(block))
    assert sorted(kind for kind, _ in found) == ["cylinder"] + ["plane"] * 6  # the tool's ends are gone
    ((_, wall),) = [item for item in found if item[0] == "cylinder"]
    assert wall == pytest.approx(2 * np.pi * 0.3 * 0.5, rel=3e-3)
    hole = np.pi * 0.09
    planes = sorted(size for kind, size in found if kind == "plane")
    assert planes == pytest.approx([0.5, 0.5, 1.0, 1.0, 2 - hole, 2 - hole], rel=2e-3)


def test_every_triangle_lies_on_its_surface_after_a_boolean():
    cutter = shapes.rotate(shapes.cone(0.2, 0.5, 3, (0, 0, -1.5)), 0.7, "x")
    solid = solids.difference(solids.union(shapes.sphere(0.8), shapes.cylinder(0.4, 2, (-1, 0, 0.1), "x")), cutter)
    body = solids.evaluate(solid)
    assert {surface.kind for surface in body.surfaces} == {"sphere", "cylinder", "cone", "plane"}
    doubled = solids.doubled_areas(body.vertices[body.faces])
    for index, surface in enumerate(body.surfaces):
        mine = body.surface_index == index
        corners = body.vertices[np.unique(body.faces[mine])]
        assert np.max(np.abs(solids.signed_distance(surface, corners)[0])) < 1e-6
        middle = np.mean(body.vertices[body.faces[mine]], axis=1)
        distance, gradient = solids.signed_distance(surface, middle)
        assert np.max(np.abs(distance)) < 0.01
        # Normals of the triangles follow the surface; the bore's point into the cutter.
        along = np.sum(doubled[mine] * gradient, axis=1) / np.sum(np.abs(np.sum(doubled[mine] * gradient, axis=1)))
        outside = -1.0 if surface.kind == "cone" else np.sign(np.sum(along))
        assert np.sum(along * outside) > 0.999


def test_copies_of_a_solid_keep_their_own_surfaces():
    hole = shapes.cylinder(0.1, 2, (0.6, 0, -1))
    body = solids.evaluate(solids.difference(shapes.box((2, 2, 0.5)), *shapes.ring(hole, 3)))
    centers = [surface.center[:2] for surface in body.surfaces if isinstance(surface, Cylinder)]
    assert len(centers) == 3 and np.ptp(np.hypot(*np.transpose(centers))) < 1e-12
    assert np.min([np.hypot(*(a - b)) for i, a in enumerate(centers) for b in centers[:i]]) > 1.0


def test_intersections_and_nothing_left():
    body = solids.evaluate(solids.intersection(shapes.box((1, 1, 1)), shapes.sphere(0.6)))
    assert sorted(kind for kind, _ in areas_by_surface(body)) == ["plane"] * 6 + ["sphere"]
    empty = solids.evaluate(solids.difference(shapes.box((1, 1, 1)), shapes.box((2, 2, 2))))
    assert len(empty.faces) == 0


def test_an_open_body_is_refused():
    box = shapes.box((1, 1, 1))
    with pytest.raises(ValueError, match="is not closed"):
        solids.evaluate(box._replace(faces=box.faces[1:], surface_index=box.surface_index[1:]))


def test_surfaces_move_with_the_points_on_them():
    draw = np.random.default_rng(0)
    turn, _ = np.linalg.qr(draw.normal(size=(3, 3)))
    axis, point = np.array([0.6, 0.0, 0.8]), np.array([0.1, 0.2, 0.3])
    surfaces = (
        *(Plane(axis, np.float64(0.4)), Sphere(point, np.float64(0.5))),
        *(Cylinder(axis, point, np.float64(0.7)), Cone(axis, point, np.float64(0.6))),
    )
    points = draw.normal(size=(20, 3))
    for surface in surfaces:
        moved = solids.transform_surface(surface, turn, point, 2.5)
        there = 2.5 * points @ turn.T + point[None]
        expected, slope = solids.signed_distance(surface, points)
        distance, gradient = solids.signed_distance(moved, there)
        assert distance == pytest.approx(2.5 * expected)
        assert gradient == pytest.approx(slope @ turn.T)
        step = 1e-6 * gradient  # the gradient is unit and leads away from the surface
        assert solids.signed_distance(moved, there + step)[0] - distance == pytest.approx(np.full(20, 1e-6), rel=1e-3)
    assert solids.transform_surface(None, turn, point, 2.5) is None
