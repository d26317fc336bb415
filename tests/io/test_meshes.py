"""Sampling by area: uniform, reproducible, on the surface."""

from pathlib import Path

import numpy as np
import pytest

from jprimfit.io.files import Mesh
from jprimfit.io.meshes import cloud_of_mesh, sample

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
