"""Features: what is put together per primitive, and the sentences that say where the evidence is thin."""

import numpy as np
import pytest

from jprimfit.cad import charts
from jprimfit.cad.features import feature, features
from jprimfit.cad.patches import patch
from jprimfit.data.families import FAMILIES
from jprimfit.data.instances import make_part
from jprimfit.data.surfaces import draw
from jprimfit.types import Cone, Cylinder, Plane, Sphere

Z, ZERO = np.array([0.0, 0.0, 1.0]), np.zeros(3)


def _around(angle, radius, height):
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def _of(primitive, points):
    return feature(primitive, points, patch(primitive, points))


def _cylinder(num_points, turn, noise=0.001):
    random = np.random.default_rng(0)
    radius = 2 + noise * random.standard_normal(num_points)
    return _around(random.uniform(0, turn, num_points), radius, random.uniform(0, 3, num_points))


def test_deviations_are_signed_and_those_of_the_points():
    points = _cylinder(2000, 2 * np.pi)
    points[5] *= [1.99 / 2, 1.99 / 2, 1]
    found = _of(Cylinder(Z, ZERO, np.float64(2)), points)
    signed = np.hypot(points[:, 0], points[:, 1]) - 2
    assert found.largest_deviation == pytest.approx(signed[5]) and signed[5] < 0
    assert found.rms == pytest.approx(np.sqrt(np.mean(signed**2))) and found.num_points == 2000
    assert found.warning == "" and found.standard_errors["radius"] == pytest.approx(found.rms / np.sqrt(2000), rel=0.01)


CAP = _around(*np.random.default_rng(0).uniform([[0], [0]], [[6.28], [0.4]], (2, 500)), np.zeros(500))


@pytest.mark.parametrize(
    ("primitive", "points", "warning"),
    [
        (Cylinder(Z, ZERO, np.float64(2)), _cylinder(2000, 0.7), "only 40 deg of the turn seen"),
        (Cylinder(Z, ZERO, np.float64(2)), _cylinder(40, 2 * np.pi), "only 40 points"),
        (Cylinder(Z, ZERO, np.float64(2)), _cylinder(300, 2 * np.pi, noise=0.5), "radius hardly known"),
        (Cone(Z, -40 * Z, np.float64(0.05)), _cylinder(2000, 2 * np.pi), "nearly a cylinder"),
        (
            Sphere(2 * Z, np.float64(2)),
            _around(*np.random.default_rng(0).uniform(0, 0.3, (2, 500)), np.zeros(500)),
            "% of",
        ),
        (Plane(Z, np.float64(0)), np.zeros((2, 3)), "too few points for a surface"),
        (Plane(Z, np.float64(0)), np.random.default_rng(0).normal(size=(80, 3)), "normal hardly known"),
    ],
)
def test_thin_evidence_is_told(primitive, points, warning):
    assert warning in _of(primitive, points).warning


@pytest.mark.parametrize("kind", ["plane", "sphere", "cylinder", "cone"])
def test_no_points_are_no_failure(kind):
    one = np.float64(0.5)
    made = {"plane": Plane(Z, one), "sphere": Sphere(ZERO, one), "cylinder": Cylinder(Z, ZERO, one)}
    found = _of(made.get(kind, Cone(Z, ZERO, one)), np.zeros((0, 3)))
    assert found.num_points == 0 and np.isnan(found.rms) and found.area == 0 and found.warning
    assert np.isfinite(found.position).all() and set(found.standard_errors.values()) == {np.inf}


def test_each_primitive_has_its_own_points():
    points = np.concatenate([_cylinder(500, 2 * np.pi), np.random.default_rng(1).normal(size=(300, 3)) * [1, 1, 0]])
    primitives = (Plane(Z, np.float64(0)), Cylinder(Z, ZERO, np.float64(2)))
    rows = (np.arange(500, 800), np.arange(500))
    found = features(primitives, points, rows, [patch(p, points[r]) for p, r in zip(primitives, rows, strict=True)])
    assert [f.num_points for f in found] == [300, 500] and found[0].is_hole is None and found[0].arc is None
    assert found[1].length == pytest.approx(3, rel=0.02)


@pytest.mark.parametrize(
    "broken", [Cylinder(ZERO, ZERO, np.float64(1)), Sphere(ZERO, np.float64(0)), Plane(Z, np.float64(np.nan))]
)
def test_what_is_no_surface_is_said_to_be_none(broken):
    found = feature(
        broken, np.random.default_rng(0).normal(size=(50, 3)), patch(Sphere(ZERO, np.float64(1)), Z[None, :])
    )
    assert found.warning == "parameters are no surface" and found.standard_errors is None and found.num_points == 50


@pytest.mark.parametrize(("size", "shift"), [(1e-6, 0.0), (1e4, 1e6)])
def test_unit_and_place_of_the_scan_do_not_matter(size, shift):
    points = _cylinder(3000, 5.0)
    near = _of(Cylinder(Z, ZERO, np.float64(2)), points)
    moved = Cylinder(Z, np.full(3, shift), np.float64(2 * size))
    far = _of(moved, size * points + shift)
    for name in ("length", "rms", "largest_deviation"):
        assert getattr(far, name) == pytest.approx(size * getattr(near, name), rel=1e-3)
    assert far.area == pytest.approx(size**2 * near.area, rel=1e-3) and far.arc == pytest.approx(near.arc, rel=1e-6)
    assert far.standard_errors["radius"] == pytest.approx(size * near.standard_errors["radius"], rel=1e-3)
    np.testing.assert_allclose((far.ends - shift) / size, near.ends, atol=1e-6)


def _built(family):
    """A generated part's cloud, and for each instance whether its triangles say that it is a hole."""
    part = make_part(FAMILIES[family](np.random.default_rng(2)), min_share=0.001, name=family)
    assert part is not None and part.mesh is not None
    corners = part.mesh.vertices.astype(np.float64)[part.mesh.faces]
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inside = []
    for label, primitive in enumerate(part.primitives):
        mine = part.mesh.labels == label
        inside.append(np.sum(outwards[mine] * charts.normals(primitive, corners[mine].mean(axis=1))) < 0)
    return part, draw(part, num_points=16_384, seed=0, num_samples=0), inside


@pytest.mark.parametrize("family", ["flange", "drilled_plate", "dome_cap"])
def test_holes_bosses_and_lengths_of_generated_parts(family):
    part, cloud, inside = _built(family)
    assert part.mesh is not None
    points = cloud.points + 0.001 * np.random.default_rng(0).standard_normal(cloud.points.shape)
    rows = [np.flatnonzero(cloud.labels == i) for i in range(len(part.primitives))]
    trimmed = [patch(p, points[r]) for p, r in zip(part.primitives, rows, strict=True)]
    lengths = []
    for i, found in enumerate(features(part.primitives, points, rows, trimmed)):
        primitive = part.primitives[i]
        if not isinstance(primitive, Plane) and len(rows[i]) > 100:
            assert found.is_hole == inside[i], (i, primitive)
        if isinstance(primitive, Cylinder) and len(rows[i]) > 500:
            heights = part.mesh.vertices[part.mesh.faces[part.mesh.labels == i]] @ primitive.axis
            lengths.append(found.length / np.ptp(heights))
    assert len(lengths) > 0 and lengths == pytest.approx([1.0] * len(lengths), abs=0.015)
