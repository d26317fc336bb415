"""Areas of exact faces over coarse triangles, beside formulas: curved faces and edges, cuts, and what has no kind."""

import numpy as np
import pytest

from jprimfit.data import areas, shapes, solids

TURNED = {
    "ball": (shapes.sphere(0.7), {"sphere": 4 * np.pi * 0.7**2}),
    "cylinder": (shapes.cylinder(0.4, 2), {"cylinder": 2 * np.pi * 0.4 * 2, "plane": 2 * np.pi * 0.4**2}),
    "cone": (shapes.cone(0.5, 0.0, 1.2), {"cone": np.pi * 0.5 * 1.3, "plane": np.pi * 0.5**2}),
    "frustum": (shapes.cone(0.5, 0.2, 0.4), {"cone": np.pi * 0.7 * 0.5, "plane": np.pi * (0.5**2 + 0.2**2)}),
}


def by_kind(solid):
    body = solids.evaluate(solid)
    kinds = [surface.kind if surface else "other" for surface in body.surfaces]
    sums = np.bincount(body.surface_index, areas.exact_areas(body), len(kinds))
    return {kind: sum(size for name, size in zip(kinds, sums, strict=True) if name == kind) for kind in kinds}


@pytest.mark.parametrize("name", TURNED)
def test_of_turned_bodies(name):
    solid, expected = TURNED[name]
    # At an apex the patches are too simple: of the 0.13 % that the triangles miss there, 0.05 are left.
    assert by_kind(solids.evaluate(solid)) == pytest.approx(expected, rel=6e-4 if name == "cone" else 1e-4)


def test_of_a_ball_cut_by_a_plane_and_of_crossing_cylinders():
    cap = solids.intersection(shapes.sphere(1.0), shapes.box((4, 4, 4), (0, 0, 2.5)))
    assert by_kind(cap) == pytest.approx({"sphere": 2 * np.pi * 0.5, "plane": np.pi * 0.75}, rel=2e-4)
    # The bicylinder of Archimedes: two equal cylinders at right angles enclose 16 r^2 of surface.
    both = solids.intersection(shapes.cylinder(0.5, 4, (0, 0, -2)), shapes.cylinder(0.5, 4, (-2, 0, 0), "x"))
    assert by_kind(both) == pytest.approx({"cylinder": 16 * 0.25}, rel=1e-3)


def test_the_triangles_themselves_fall_short():
    """What the exact areas mend: a ball of 24 chords has one per cent less."""
    body = solids.evaluate(shapes.sphere(0.2))
    flat = np.linalg.norm(solids.doubled_areas(body.vertices[body.faces]), axis=1).sum() / 2
    assert flat < 0.993 * 4 * np.pi * 0.2**2
    assert areas.exact_areas(body).sum() == pytest.approx(4 * np.pi * 0.2**2, rel=3e-4)


def test_what_has_no_kind_keeps_the_area_of_its_triangles():
    ring = shapes.revolve(shapes.disc(0.2, (0.6, 0.0)))
    body = solids.evaluate(ring)
    flat = np.linalg.norm(solids.doubled_areas(body.vertices[body.faces]), axis=1) / 2
    assert set(body.surfaces) == {None} and areas.exact_areas(body) == pytest.approx(flat, rel=1e-12)
