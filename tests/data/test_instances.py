"""From solids to labelled parts: what merges, what stays apart, what is background, and the frame."""

import numpy as np
import pytest

from jprimfit.data import instances, records, shapes, solids
from jprimfit.types import Cone, Cylinder, Plane, Sphere


def part_of(solid, *, min_share=0.0):
    part = instances.make_part(solid, min_share=min_share, name="part", family="f", split="train", seed=3)
    assert part is not None
    records.check(part, source="test")
    return part


def count(part, kind):
    return sum(primitive.kind == kind for primitive in part.primitives)


def test_a_block_with_a_hole():
    part = part_of(solids.difference(shapes.box((4, 2, 1), (7, 8, 9)), shapes.cylinder(0.5, 9, (7, 8, 5))))
    assert [primitive.kind for primitive in part.primitives].count("plane") == 6 and count(part, "cylinder") == 1
    assert part.scale == pytest.approx(2.0) and part.center == pytest.approx([7, 8, 9])
    hole = np.pi * 0.25
    expected = [8 - hole, 8 - hole, 4, 4, np.pi, 2, 2]
    assert part.areas * part.scale**2 == pytest.approx(expected, rel=1e-4)
    assert list(part.areas) == sorted(part.areas, reverse=True) and part.background_area == 0.0
    assert (part.family, part.split, part.seed) == ("f", "train", 3)
    assert instances.largest_residual(part) < 1e-6
    sizes = np.ptp(part.mesh.vertices, axis=0)
    assert sizes == pytest.approx([2, 1, 0.5], abs=1e-6)


def test_flush_faces_merge_and_separate_ones_do_not():
    flush = solids.union(shapes.box((2, 1, 1)), shapes.box((1, 1, 1), (1.2, 0, 0)))
    assert count(part_of(flush), "plane") == 6
    stepped = solids.union(shapes.box((2, 1, 1)), shapes.box((0.5, 1, 1), (0, 0, 0.5)))  # the top is cut in two
    assert count(part_of(stepped), "plane") == 4 + 2 + 1 + 1 + 2
    rod = solids.union(shapes.cylinder(0.3, 1), shapes.cylinder(0.3, 1, (0, 0, 0.8)))
    assert (count(part_of(rod), "cylinder"), count(part_of(rod), "plane")) == (1, 2)
    grooved = solids.difference(shapes.cylinder(0.3, 2), shapes.box((1, 1, 0.1), (0, 0, 1)))
    assert instances.make_part(grooved, min_share=0.0, name="two") is None  # it fell in two
    waisted = solids.union(grooved, shapes.cylinder(0.2, 2))
    assert count(part_of(waisted), "cylinder") == 3  # one radius twice, not touching


def test_small_pieces_are_background():
    plate = solids.difference(shapes.box((2, 2, 0.2)), shapes.cylinder(0.03, 1, (0, 0, -0.5)))
    all_of_it, without = part_of(plate), part_of(plate, min_share=0.005)
    assert len(all_of_it.primitives) == 7 and len(without.primitives) == 6
    assert without.background_area == pytest.approx(2 * np.pi * 0.03 * 0.2, rel=1e-3)
    assert np.sum(without.areas) + without.background_area == pytest.approx(np.sum(all_of_it.areas))
    assert np.sum(without.mesh.labels == records.BACKGROUND) == np.sum(all_of_it.mesh.labels == 6)


def test_a_fillet_of_a_torus_is_background():
    shaft = shapes.revolve(
        shapes.polygon([(0, 0), (1, 0), (1, 1), (0.5, 1), (0.5, 2), (0, 2)], [0, 0, 0, 0.2, 0, 0]),
    )
    part = part_of(shaft)
    assert (count(part, "plane"), count(part, "cylinder")) == (3, 2) and part.background_area > 0.1


def test_primitives_stand_in_their_gauge():
    turned = shapes.rotate(
        shapes.rotate(solids.union(shapes.box((1, 1, 1)), shapes.cone(0.3, 0.1, 2)), 2.5, "x"), 1, "z"
    )
    part = part_of(solids.difference(turned, shapes.cylinder(0.1, 9, (4, 0.2, 0.1), "-x")))
    middle = np.mean(part.mesh.vertices[part.mesh.faces], axis=1)
    weight = np.sqrt(np.sum(solids.doubled_areas(part.mesh.vertices[part.mesh.faces]) ** 2, axis=1))
    for label, primitive in enumerate(part.primitives):
        mine = part.mesh.labels == label
        mean = np.average(middle[mine], axis=0, weights=weight[mine])
        if isinstance(primitive, Plane | Cylinder):
            direction = primitive[0]
            assert direction[np.argmax(np.abs(direction))] > 0
        if isinstance(primitive, Cylinder):
            assert (mean - primitive.center) @ primitive.axis == pytest.approx(0, abs=1e-3)
        if isinstance(primitive, Cone):
            assert np.all((part.mesh.vertices[np.unique(part.mesh.faces[mine])] - primitive.apex) @ primitive.axis > 0)
    assert {primitive.kind for primitive in part.primitives} == {"plane", "cylinder", "cone"}


def test_what_is_no_single_piece_is_refused():
    def made(solid):
        return instances.make_part(solid, min_share=0.0, name="x")

    assert made(solids.union(shapes.box((1, 1, 1)), shapes.box((1, 1, 1), (3, 0, 0)))) is None
    assert made(solids.difference(shapes.box((1, 1, 1)), shapes.sphere(0.3))) is None  # a hidden hollow
    assert made(solids.difference(shapes.box((1, 1, 1)), shapes.box((2, 2, 2)))) is None
    assert instances.make_part(shapes.box((1, 1, 1)), min_share=0.5, name="x") is None  # nothing large enough


AXIS, POINT = np.array([0.0, 0.6, 0.8]), np.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        (Plane(AXIS, 1.0), Plane(-AXIS, -1.0), True),
        (Plane(AXIS, 1.0), Plane(-AXIS, 1.0), False),
        (Sphere(POINT, 1.0), Sphere(POINT + 0.0, 1.0), True),
        (Sphere(POINT, 1.0), Sphere(POINT, 1.01), False),
        (Cylinder(AXIS, POINT, 1.0), Cylinder(-AXIS, POINT + 5 * AXIS, 1.0), True),
        (Cylinder(AXIS, POINT, 1.0), Cylinder(AXIS, POINT + np.array([0.1, 0, 0]), 1.0), False),
        (Cone(AXIS, POINT, 0.5), Cone(AXIS, POINT, 0.5), True),
        (Cone(AXIS, POINT, 0.5), Cone(-AXIS, POINT, 0.5), False),
        (Cone(AXIS, POINT, 0.5), Cylinder(AXIS, POINT, 0.5), False),
        (None, None, True),
        (None, Plane(AXIS, 1.0), False),
    ],
)
def test_surfaces_are_compared_free_of_gauge(first, second, same):
    assert instances.is_same(first, second) is same and instances.is_same(second, first) is same
