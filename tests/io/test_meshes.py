"""Sampling by area: uniform, reproducible, on the surface."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from jprimfit.io.files import Mesh
from jprimfit.io.meshes import chord_height, cloud_of_mesh, sample

VERTICES = np.array([[0.0, 0, 0], [3, 0, 0], [3, 3, 0], [0, 3, 0], [0, 0, 5], [1, 0, 5], [0, 1, 5]])
FACES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]])


def test_points_are_uniform_over_the_area():
    points = sample(VERTICES, FACES, num_samples=20_000, seed=0)
    assert abs(np.mean(points[:, 2] == 5) - 0.5 / 9.5) < 0.006
    square = points[points[:, 2] == 0]
    counts = np.histogram2d(square[:, 0], square[:, 1], bins=3, range=[[0, 3], [0, 3]])[0]
    assert np.sum((counts - counts.mean()) ** 2 / counts.mean()) < 26  # chi square, 8 degrees of freedom, p = 0.001


def test_the_seed_alone_decides():
    first = sample(VERTICES, FACES, num_samples=50, seed=3)
    np.testing.assert_array_equal(first, sample(VERTICES, FACES, num_samples=50, seed=3))
    assert np.any(first != sample(VERTICES, FACES, num_samples=50, seed=4))


def test_degenerate_triangles_get_no_points():
    vertices = np.concatenate([VERTICES, [[np.nan, 0, 0], [np.inf, 1, 1]]])
    faces = np.concatenate([FACES, [[0, 0, 1], [0, 1, 7], [1, 2, 8]]])
    points = sample(vertices, faces, num_samples=1000, seed=0)
    assert points.shape == (1000, 3) and np.all(np.isfinite(points))


def test_triangles_whose_corners_are_infinite_or_too_far_apart_get_no_points():
    vertices = np.concatenate([VERTICES, [[np.inf, 0, 0], [np.inf, 1, 0], [1.7e308, 0, 0], [-1.7e308, 0, 0]]])
    faces = np.concatenate([FACES, [[7, 8, 0], [8, 7, 1], [9, 10, 0]]])
    points = sample(vertices, faces, num_samples=1000, seed=0)
    assert points.shape == (1000, 3) and np.all(np.abs(points) <= 5)


def test_far_from_the_origin_points_stay_on_the_surface():
    points = sample(VERTICES + 1e6, FACES[:2], num_samples=1000, seed=0)
    assert np.max(np.abs(points[:, 2] - 1e6)) == 0


def test_a_mesh_without_faces_is_its_vertices_and_one_without_area_is_refused():
    normals = np.ones_like(VERTICES)
    cloud = cloud_of_mesh(Mesh(VERTICES, np.zeros((0, 3), np.int64), normals), Path("a.obj"))
    np.testing.assert_array_equal(cloud.points, VERTICES)
    assert cloud.normals is normals
    with pytest.raises(ValueError, match="a.obj is a mesh whose 1 faces have no area"):
        cloud_of_mesh(Mesh(VERTICES, np.array([[0, 1, 1]]), None), Path("a.obj"))


def prism(sides, *, radius=10.0, height=30.0):
    """A closed prism as STL holds it, three vertices per triangle."""
    turn = 2 * np.pi * np.arange(sides) / sides
    low = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros(sides)], axis=1)
    high, following = low + [0, 0, height], np.roll(np.arange(sides), -1)
    walls = [low, low[following], high[following], low, high[following], high]
    lids = [np.zeros((sides, 3)), low[following], low, np.tile([0, 0, height], (sides, 1)), high, high[following]]
    vertices = np.stack([*walls, *lids], axis=1).reshape(-1, 3)
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


@pytest.mark.parametrize("sides", [16, 32, 64])
def test_the_height_of_chords_is_that_of_the_arc_over_them(sides):
    vertices, faces = prism(sides)
    assert chord_height(vertices, faces) == pytest.approx(10 * (1 - np.cos(np.pi / sides)), rel=1e-6)
    assert cloud_of_mesh(Mesh(vertices, faces, None), Path("a.stl")).tolerance == chord_height(vertices, faces)


def test_a_hexagon_and_a_wedge_are_meant_as_they_are():
    assert chord_height(*prism(6)) is None
    wedge = np.array([[0.0, 0, 0], [1, 0, 0], [1, 5, 0], [0, 5, 0], [-1, 5, 0.3], [-1, 0, 0.3]])  # 17 degrees
    assert chord_height(wedge, np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])) is None


def test_a_ball_fitted_to_triangles_lies_within_the_height_of_their_chords():
    directions = np.random.default_rng(0).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for _ in range(40):  # pushed apart, so that the triangles are alike
        apart = directions[:, None] - directions[None]
        directions += 0.002 * np.sum(apart / (np.sum(apart**2, axis=2, keepdims=True) + 1e-3) ** 1.5, axis=1)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    faces = ConvexHull(directions).simplices
    a, b, c = np.moveaxis(directions[faces], 1, 0)
    inside = np.einsum("fi,fi->f", np.cross(b - a, c - a), a) < 0
    faces[inside] = faces[inside][:, ::-1]
    points = sample(directions, faces, num_samples=20_000, seed=0)
    depth = 1 - np.linalg.norm(points, axis=1)
    height = chord_height(directions, faces)
    assert np.std(depth) < height < 2 * depth.mean()


def test_a_fine_mesh_and_one_in_pieces_have_no_height():
    vertices, faces = prism(32)
    many = np.tile(faces, (100, 1))
    assert cloud_of_mesh(Mesh(vertices, many, None), Path("a.stl")).tolerance is None
    assert chord_height(vertices + np.repeat(np.random.default_rng(0).normal(size=(128, 3)), 3, axis=0), faces) is None
