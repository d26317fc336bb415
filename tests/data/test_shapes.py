"""Building blocks: closed, outward, on their surfaces, of the volume and area that a formula gives."""

import numpy as np
import pytest

from jprimfit.data import shapes, solids


def volume(body):
    corners = body.vertices[body.faces]
    return np.sum(corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])) / 6


def face_areas(body):
    """Area per surface."""
    doubled = solids.doubled_areas(body.vertices[body.faces])
    return np.bincount(body.surface_index, weights=np.sqrt(np.sum(doubled**2, axis=1)) / 2)


def kinds(body):
    return [surface and surface.kind for surface in body.surfaces]


def residual(body):
    worst = 0.0
    for index, surface in enumerate(body.surfaces):
        if surface is not None:
            corners = body.vertices[np.unique(body.faces[body.surface_index == index])]
            worst = max(worst, np.max(np.abs(solids.signed_distance(surface, corners)[0])))
    return worst


L_SHAPE = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 3), (0, 3)]
BODIES = {  # body, volume, names of its surfaces
    "box": (shapes.box((1, 2, 3), (5, 6, 7)), 6.0, ["plane"] * 6),
    "cylinder": (shapes.cylinder(0.5, 2.0, (1, 0, 0), "x"), np.pi / 2, ["plane", "cylinder", "plane"]),
    "frustum": (shapes.cone(1.0, 0.5, 3.0), np.pi * (1 + 0.5 + 0.25), ["plane", "cone", "plane"]),
    "pointed cone": (shapes.cone(0.0, 0.5, 3.0), np.pi / 4, ["cone", "plane"]),
    "ball": (shapes.sphere(0.5, (1, 2, 3)), np.pi / 6, ["sphere"]),
    "prism": (shapes.extrude(shapes.polygon(L_SHAPE), 0.5), 2.0, ["plane"] * 8),
    "hexagon": (shapes.extrude(shapes.regular(6, 2.0), 1.0), 2 * np.sqrt(3), ["plane"] * 8),
    "stadium": (shapes.extrude(shapes.stadium(1, 0.5), 1), 1 + np.pi / 4, ["plane", "cylinder"] * 2 + 2 * ["plane"]),
    "drill": (shapes.drill(0.5, 1.0, np.pi / 4), np.pi / 4 * (1.05 + 0.5 / 3), ["cone", "cylinder", "plane"]),
    "round drill": (shapes.drill(0.5, 1.0, -1.0), np.pi / 4 * 1.05 + np.pi / 12, ["sphere", "cylinder", "plane"]),
    "clockwise": (shapes.extrude(shapes.polygon(L_SHAPE[::-1]), 0.5), 2.0, ["plane"] * 8),
}  # fmt: skip


@pytest.mark.parametrize("name", BODIES)
def test_bodies_are_closed_outward_and_exact(name):
    body, expected, names = BODIES[name]
    ends = np.sort(body.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert np.all(np.unique(ends, axis=0, return_counts=True)[1] == 2)
    assert kinds(body) == names and residual(body) < 1e-12
    assert volume(body) == pytest.approx(expected, rel=0.02) and volume(body) <= expected * (1 + 1e-9)
    doubled = solids.doubled_areas(body.vertices[body.faces])
    for index, surface in enumerate(body.surfaces):  # normals agree with the surface, all of one side
        mine = body.surface_index == index
        _, gradient = solids.signed_distance(surface, np.mean(body.vertices[body.faces[mine]], axis=1))
        along = np.sum(doubled[mine] * gradient, axis=1)
        assert np.all(along > 0) or np.all(along < 0)


def test_a_polygon_is_rounded_and_bevelled():
    profile = shapes.polygon([(0, 0), (4, 0), (4, 4), (0, 4)], [1.0, 0.0, -1.0, 0.5])
    body = shapes.extrude(profile, 1.0)
    cylinders = [surface for surface in body.surfaces if surface.kind == "cylinder"]
    assert sorted(surface.radius for surface in cylinders) == pytest.approx([0.5, 1.0])
    assert min(cylinders, key=lambda c: c.center[0] + c.center[1]).center == pytest.approx([1, 1, 0])
    assert volume(body) == pytest.approx(16 - (1 - np.pi / 4) * 1.25 - 0.5, rel=2e-3)
    assert kinds(body).count("plane") == 7


def test_turned_arcs_off_the_axis_are_no_primitive():
    ring = shapes.revolve(shapes.disc(0.3, (1.0, 0.0)))
    assert kinds(ring) == [None, None]
    assert volume(ring) == pytest.approx(2 * np.pi**2 * 0.09, rel=0.03)


def test_a_belt_is_tangent():
    body = shapes.extrude(shapes.tangent_hull(1.0, 0.5, 2.0), 1.0)
    assert sorted(kinds(body)[:4]) == ["cylinder", "cylinder", "plane", "plane"]
    flat = [surface for surface in body.surfaces[:4] if surface.kind == "plane"]
    for surface in flat:  # at the radius from both centres
        assert abs(surface.offset) == pytest.approx(1.0)
        assert abs(surface.normal[0] * 2 - surface.offset) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("along", "tip"),
    [("x", (3, 0, 0)), ("y", (0, 3, 0)), ("z", (0, 0, 3)), ("-x", (-3, 0, 0)), ("-y", (0, -3, 0)), ("-z", (0, 0, -3))],
)
def test_placing_turns_z_onto_the_axis(along, tip):
    body = shapes.place(shapes.cone(1.0, 0.0, 3.0), (1, 2, 3), along)
    (cone,) = [surface for surface in body.surfaces if surface.kind == "cone"]
    assert cone.apex - [1, 2, 3] == pytest.approx(tip) and cone.axis == pytest.approx(-np.array(tip) / 3)
    assert volume(body) > 0 and residual(body) < 1e-12


def test_rotation_and_rings():
    about = shapes.rotate(shapes.sphere(0.1, (1, 0, 0)), np.pi / 2, "y")
    assert about.surfaces[0].center == pytest.approx([0, 0, -1])
    four = shapes.ring(shapes.sphere(0.1, (1, 0, 5)), 4, phase=np.pi / 2)
    assert np.array([ball.surfaces[0].center for ball in four]) == pytest.approx(
        np.array([(0, 1, 5), (-1, 0, 5), (0, -1, 5), (1, 0, 5)])
    )


def test_chords_stay_near_the_circle():
    counts = [shapes.segments(radius) for radius in (1e-6, 0.01, 0.1, 0.3, 1.0, 5.0)]
    assert counts == sorted(counts) and counts[0] == 24 and counts[-1] == 72 and all(n % 4 == 0 for n in counts)
    assert 0.3 * (1 - np.cos(np.pi / shapes.segments(0.3))) < 0.002
