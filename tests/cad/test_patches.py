import numpy as np
import pytest
from scipy.spatial import KDTree

from jprimfit.cad import patches
from jprimfit.types import Cone, Cylinder, Plane, Sphere

Z, ZERO = np.array([0.0, 0.0, 1.0]), np.zeros(3)
HALF_ANGLE = 0.5


def plate(rng, n):
    points = rng.uniform(-1, 1, (n, 2))
    points = points[np.hypot(*points.T) > 0.25]
    return np.c_[points, np.zeros(len(points))]


def cylinder(rng, n, turn=2 * np.pi):
    angle = rng.uniform(0, turn, n)
    return np.c_[np.cos(angle), np.sin(angle), rng.uniform(-1, 1, n)]


def cone(rng, n, low, high):
    slant, angle = np.sqrt(rng.uniform(low**2, high**2, n)), rng.uniform(0, 2 * np.pi, n)
    radius = slant * np.sin(HALF_ANGLE)
    return np.c_[radius * np.cos(angle), radius * np.sin(angle), slant * np.cos(HALF_ANGLE)]


def sphere(rng, n, low, high):
    z, angle = rng.uniform(low, high, n), rng.uniform(0, 2 * np.pi, n)
    return np.c_[np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z]


ONE = np.float64(1.0)
# name: primitive, sampler, true area, boundary loops, allowed relative error of the area
CASES = {
    "plate with a hole": (Plane(Z, np.float64(0)), plate, 4 - np.pi * 0.25**2, 2),
    "cylinder": (Cylinder(Z, ZERO, ONE), cylinder, 4 * np.pi, 2),
    "half a cylinder": (Cylinder(Z, ZERO, ONE), lambda r, n: cylinder(r, n, np.pi), 2 * np.pi, 1),
    "frustum": (
        Cone(Z, ZERO, np.float64(HALF_ANGLE)),
        lambda r, n: cone(r, n, 1, 3),
        8 * np.pi * np.sin(HALF_ANGLE),
        2,
    ),
    "cone with its tip": (
        Cone(Z, ZERO, np.float64(HALF_ANGLE)),
        lambda r, n: cone(r, n, 0, 3),
        9 * np.pi * np.sin(HALF_ANGLE),
        1,
    ),
    "sphere": (Sphere(ZERO, ONE), lambda r, n: sphere(r, n, -1, 1), 4 * np.pi, 0),
    "cap": (Sphere(ZERO, ONE), lambda r, n: sphere(r, n, 0.5, 1), np.pi, 1),
    "band": (Sphere(ZERO, ONE), lambda r, n: sphere(r, n, -0.3, 0.3), 1.2 * np.pi, 2),
}


def euler(patch):
    edges = np.unique(np.sort(np.concatenate([patch.faces[:, [0, 1]], patch.faces[:, [1, 2]], patch.faces[:, [2, 0]]])))
    pairs = np.sort(np.concatenate([patch.faces[:, [0, 1]], patch.faces[:, [1, 2]], patch.faces[:, [2, 0]]]), axis=1)
    assert len(edges) == len(patch.vertices)
    return len(patch.vertices) - len(np.unique(pairs, axis=0)) + len(patch.faces)


@pytest.mark.parametrize("name", CASES)
def test_area_holes_seams_and_reach(name):
    primitive, sampler, true_area, num_loops = CASES[name]
    points = sampler(np.random.default_rng(0), 4_000)
    patch = patches.patch(primitive, points)
    assert abs(patches.area(patch) / true_area - 1) < 0.02
    loops = patches.boundary_loops(patch)
    assert len(loops) == num_loops
    assert len(patches.components(patch)) == 1
    # A sphere with b holes: 2 - b. This fails for a seam, a crack or a pinch.
    assert euler(patch) == 2 - num_loops
    spacing = np.median(KDTree(points).query(points, k=2)[0][:, 1])
    reach = KDTree(points).query(patch.vertices)[0].max()
    assert reach <= 2.5 * 2 * spacing * 1.1  # the spacing is estimated, within 10 %
    a, b, c = (patch.vertices[patch.faces[:, i]] for i in range(3))
    turn = np.cross(b - a, c - a)
    facing = np.sum(turn * patch.normals[patch.faces].sum(axis=1), axis=1)
    assert facing.min() >= -1e-12 * np.abs(facing).max() and np.mean(facing > 0) > 0.999


def test_vertices_lie_on_a_primitive_far_from_the_origin():
    shift = np.array([1e6, -2e6, 5e5])
    rng = np.random.default_rng(1)
    patch = patches.patch(Sphere(shift, ONE), sphere(rng, 2_000, 0.2, 1) + shift)
    assert np.abs(np.linalg.norm(patch.vertices - shift, axis=1) - 1).max() < 1e-9
    patch = patches.patch(Cylinder(Z, shift, ONE), cylinder(rng, 2_000) + shift)
    assert np.abs(np.linalg.norm((patch.vertices - shift)[:, :2], axis=1) - 1).max() < 1e-9
    assert abs(patches.area(patch) / (4 * np.pi) - 1) < 0.03


def test_scale_changes_nothing_but_the_scale():
    points = plate(np.random.default_rng(2), 1_500)
    one = patches.patch(Plane(Z, np.float64(0)), points)
    tiny = patches.patch(Plane(Z, np.float64(0)), points * 1e-6)
    assert np.array_equal(one.faces, tiny.faces)
    np.testing.assert_allclose(tiny.vertices * 1e6, one.vertices, atol=1e-9)


def test_noise_off_the_surface_does_not_matter_much():
    rng = np.random.default_rng(3)
    points = cylinder(rng, 4_000) * (1 + 0.02 * rng.normal(size=(4_000, 1)) * np.array([1, 1, 0]))
    patch = patches.patch(Cylinder(Z, ZERO, ONE), points)
    assert abs(patches.area(patch) / (4 * np.pi) - 1) < 0.03


def test_two_separate_regions_stay_separate_and_stray_points_are_left_out():
    rng = np.random.default_rng(4)
    left, right = rng.uniform(0, 1, (2, 1_500, 2)) + np.array([[[0.0, 0]], [[2.0, 0]]])
    flat = np.concatenate([left, right, [[1.5, 0.5]]])
    patch = patches.patch(Plane(Z, np.float64(3)), np.c_[flat, np.full(len(flat), 3.0)])
    pieces = patches.components(patch)
    assert len(pieces) == 2
    assert all(abs(patches.area(piece) - 1) < 0.03 for piece in pieces)


def test_line_scans_hold_together():
    # Points 20 times denser along the lines than between them.
    x, y = np.meshgrid(np.arange(0, 1, 0.002), np.arange(0, 1, 0.01))
    patch = patches.patch(Plane(Z, np.float64(0)), np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1))
    assert len(patches.boundary_loops(patch)) == 1 and abs(patches.area(patch) - 1) < 0.05


def test_the_number_of_cells_is_capped():
    rng = np.random.default_rng(5)
    points = np.c_[rng.uniform(0, 1e6, (200, 2)), np.zeros(200)]
    patch = patches.patch(Plane(Z, np.float64(0)), points, spacing=1e-3, max_vertices=5_000)
    assert len(patch.vertices) < 10_000
    dense = np.c_[rng.uniform(0, 1, (30_000, 2)), np.zeros(30_000)]
    patch = patches.patch(Plane(Z, np.float64(0)), dense, max_vertices=2_000)
    assert 500 < len(patch.vertices) < 3_000 and abs(patches.area(patch) - 1) < 0.05


@pytest.mark.parametrize("primitive", [case[0] for case in CASES.values()][::2], ids=lambda p: p.kind)
def test_degenerate_segments_give_small_or_empty_patches(primitive):
    line = np.linspace(0, 1, 20)[:, None] * np.array([[0.3, 0.2, 0.1]]) + np.array([[1.0, 0, 0.5]])
    for points in (np.zeros((0, 3)), line[:1], line[:2], np.repeat(line[:1], 30, axis=0), np.full((5, 3), np.nan)):
        patch = patches.patch(primitive, points)
        assert patch.vertices.shape == (0, 3) and patch.faces.shape == (0, 3) and patches.area(patch) == 0
        assert patches.components(patch) == [] and patches.boundary_loops(patch) == []
    for points in (line[:3], line, np.concatenate([line, [[np.inf, 0, 0]]])):
        patch = patches.patch(primitive, points)
        assert np.isfinite(patch.vertices).all() and patches.area(patch) < 0.5


def test_meaningless_parameters_give_an_empty_patch():
    points = np.random.default_rng(6).normal(size=(50, 3))
    for primitive in (Sphere(ZERO, np.float64(np.nan)), Plane(np.full(3, np.inf), ONE)):
        assert len(patches.patch(primitive, points).faces) == 0


def test_loops_turn_with_the_surface_on_their_left():
    patch = patches.patch(Plane(Z, np.float64(0)), plate(np.random.default_rng(7), 3_000))
    areas = []
    for loop in patches.boundary_loops(patch):
        x, y, _ = patch.vertices[loop].T
        areas.append(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    assert sorted(np.sign(areas)) == [-1, 1]
    assert sum(areas) == pytest.approx(patches.area(patch))


def test_touching_loops_are_separated():
    # Two triangles that share one vertex, and one triangle apart.
    faces = np.array([[0, 1, 2], [0, 3, 4], [5, 6, 7]], np.int32)
    patch = patches.Patch(np.random.default_rng(8).normal(size=(8, 3)), faces, np.zeros((8, 3)))
    assert sorted(sorted(loop.tolist()) for loop in patches.boundary_loops(patch)) == [[0, 1, 2], [0, 3, 4], [5, 6, 7]]


def test_spacing_is_that_of_a_random_sample_whatever_the_arrangement():
    rng = np.random.default_rng(9)
    random = np.c_[rng.uniform(0, 1, (4_000, 2)), np.zeros(4_000)]
    nearest = np.median(KDTree(random).query(random, k=2)[0][:, 1])
    assert patches.sample_spacing(random) == pytest.approx(nearest, rel=0.1)
    assert patches.sample_spacing(np.repeat(random, 2, axis=0)) < nearest
    x, y = np.meshgrid(np.arange(60) / 60, np.arange(60) / 60)
    grid = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    assert patches.sample_spacing(grid) == pytest.approx(np.sqrt(np.log(2) / np.pi) / 60, rel=0.35)
    assert patches.sample_spacing(random[:1]) == 0
