import numpy as np
import pytest

from jprimfit.cad import charts
from jprimfit.types import Cone, Cylinder, Plane, Sphere

AXIS = np.array([2.0, -1.0, 2.0]) / 3
CENTER = np.array([1.0, -2.0, 0.5])
PRIMITIVES = (
    Plane(AXIS, np.float64(0.7)),
    Sphere(CENTER, np.float64(1.3)),
    Cylinder(AXIS, CENTER, np.float64(0.8)),
    Cone(AXIS, CENTER, np.float64(0.6)),
)


def distance(primitive, points):
    """Unsigned distances by the definitions of the surfaces."""
    if primitive.kind == "plane":
        return np.abs(points @ primitive.normal - primitive.offset)
    if primitive.kind == "sphere":
        return np.abs(np.linalg.norm(points - primitive.center, axis=1) - primitive.radius)
    offset = points - (primitive.center if primitive.kind == "cylinder" else primitive.apex)
    along = offset @ primitive.axis
    across = np.linalg.norm(offset - along[:, None] * primitive.axis, axis=1)
    if primitive.kind == "cylinder":
        return np.abs(across - primitive.radius)
    slant = along * np.cos(primitive.half_angle) + across * np.sin(primitive.half_angle)
    beside = np.abs(across * np.cos(primitive.half_angle) - along * np.sin(primitive.half_angle))
    return np.where(slant > 0, beside, np.linalg.norm(offset, axis=1))


@pytest.mark.parametrize("primitive", PRIMITIVES, ids=lambda p: p.kind)
def test_feet_lie_on_the_surface_and_are_nearest(primitive):
    points = np.random.default_rng(0).normal(size=(200, 3)) * 3
    feet = charts.feet(primitive, points)
    assert distance(primitive, feet).max() < 1e-12
    np.testing.assert_allclose(np.linalg.norm(points - feet, axis=1), distance(primitive, points), atol=1e-12)


@pytest.mark.parametrize("primitive", PRIMITIVES, ids=lambda p: p.kind)
def test_normals_are_unit_and_the_gradient_of_the_distance(primitive):
    points = charts.feet(primitive, np.random.default_rng(1).normal(size=(50, 3)) * 2 + 4 * AXIS)
    normals = charts.normals(primitive, points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(distance(primitive, points + 1e-3 * normals), 1e-3, rtol=1e-6)
    if primitive.kind != "plane":
        middle = primitive.apex if primitive.kind == "cone" else primitive.center
        outward = points - middle
        if primitive.kind != "sphere":
            outward = outward - (outward @ AXIS)[:, None] * AXIS
        assert np.all(np.sum(outward * normals, axis=1) > 0)


def test_feet_and_normals_are_finite_where_the_nearest_point_is_not_unique():
    points = np.stack([CENTER, CENTER + AXIS, CENTER - AXIS])
    for primitive in PRIMITIVES:
        assert np.isfinite(charts.feet(primitive, points)).all()
        np.testing.assert_allclose(np.linalg.norm(charts.normals(primitive, points), axis=1), 1, atol=1e-12)


@pytest.mark.parametrize("primitive", PRIMITIVES, ids=lambda p: p.kind)
def test_mesh_lies_on_the_surface_reaches_the_border_and_faces_outward(primitive):
    points = charts.feet(primitive, CENTER + 2 * AXIS + 0.2 * np.random.default_rng(2).normal(size=(60, 3)))
    mesh = charts.mesh(primitive, points, pitch=0.05, border=0.2, max_vertices=20_000)
    assert mesh is not None
    assert distance(primitive, mesh.vertices).max() < 1e-12
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    turn = np.cross(b - a, c - a)
    assert np.all(np.sum(turn * charts.normals(primitive, (a + b + c) / 3), axis=1) > 0)
    ends = mesh.vertices[charts.edges(mesh.faces)[0]]
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max() < 1.6 * 0.05
    count = np.bincount(charts.edges(mesh.faces)[1].ravel())
    rim = mesh.vertices[charts.edges(mesh.faces)[0][count == 1].ravel()]
    gap = np.linalg.norm(rim[:, None] - points[None], axis=2)
    # Chords are shorter than the way along the surface, by at most pi / 2.
    assert len(rim) == 0 or gap.min() > 0.2 / 1.6


def test_closed_meshes_have_no_seam():
    angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    z, zero = np.array([0.0, 0, 1]), np.zeros(3)
    cylinder = charts.mesh(Cylinder(z, zero, np.float64(1)), ring, pitch=0.1, border=0.2, max_vertices=10_000)
    sphere = charts.mesh(Sphere(zero, np.float64(1)), ring, pitch=0.2, border=2.0, max_vertices=10_000)
    cone = charts.mesh(Cone(z, -z, np.float64(np.pi / 4)), ring, pitch=0.1, border=2.0, max_vertices=10_000)
    # Euler: vertices - edges + faces is 0 for a tube, 2 for a sphere, 1 for the disc that a cone is up to bending.
    for mesh, characteristic in ((cylinder, 0), (sphere, 2), (cone, 1)):
        assert mesh is not None
        used = len(np.unique(mesh.faces))
        assert used - len(charts.edges(mesh.faces)[0]) + len(mesh.faces) == characteristic


def test_a_small_cap_of_a_huge_sphere_is_meshed_at_the_wanted_pitch():
    sphere = Sphere(np.array([0.0, 0, -1e4]), np.float64(1e4))
    points = charts.feet(sphere, np.random.default_rng(3).uniform(-1, 1, (100, 3)))
    mesh = charts.mesh(sphere, points, pitch=0.1, border=0.2, max_vertices=20_000)
    assert mesh is not None and 400 < len(mesh.vertices) < 10_000


def test_more_vertices_than_allowed_are_refused():
    points = np.array([[0.0, 0, 0], [1e9, 1e9, 0]])
    plane = Plane(np.array([0.0, 0, 1]), np.float64(0))
    assert charts.mesh(plane, points, pitch=1e-3, border=1e-2, max_vertices=10_000) is None


def test_angular_interval_is_the_complement_of_the_widest_gap():
    interval = charts.angular_interval(np.array([3.0, -3.0, 2.5, -2.5]), gap=1.0)
    np.testing.assert_allclose([interval.start, interval.width], [2.5, 2 * np.pi - 5.0])
    assert charts.angular_interval(np.arange(0, 6.28, 0.5), gap=1.0).full
    assert charts.angular_interval(np.array([1.0]), gap=1.0).width == 0
