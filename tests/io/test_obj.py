"""OBJ: clouds, meshes in every form of f, and surfaces that come back as they were written."""

from typing import NamedTuple

import numpy as np
import pytest

from jprimfit.io import obj
from jprimfit.io.clouds import read_cloud
from jprimfit.io.meshes import NUM_SAMPLES

SQUARE = "v 0 0 0\nv 2 0 0\nv 2 1 0 1.0 0.5 0.5\nv 0 1 0\n"


class Patch(NamedTuple):
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray


def test_vertices_alone_are_a_cloud(tmp_path):
    path = tmp_path / "cloud.obj"
    path.write_text("# from a scanner\n" + SQUARE + "vn 0 0 1\n" * 4 + "l 1 2\n")
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, [[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(cloud.normals, [[0, 0, 1]] * 4)


@pytest.mark.parametrize(
    "faces", ["f 1 2 3 4\n", "f 1/1 2/1 3/1\nf 1/1 3/1 4/1\n", "f 1//1 2//1 3//1 4//1\n", "f -4 -3 \\\n-2 -1\n"]
)
def test_faces_are_sampled(tmp_path, faces):
    path = tmp_path / "mesh.obj"
    path.write_text(SQUARE + "vt 0 0\nvn 0 0 1\nusemtl a\ns off\n" + faces)
    assert obj.read(path).faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    cloud = read_cloud(path)
    assert cloud.points.shape == (NUM_SAMPLES, 3)
    np.testing.assert_allclose(cloud.points.mean(axis=0), [1, 0.5, 0], atol=0.02)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("hello\n", "no vertex line"),
        ("v 1 2\n", r"OBJ line 1 \('v 1 2'\)"),
        ("v 1 2 three\n", "OBJ line 1"),
        (SQUARE + "f 1 2 x\n", "OBJ line 5"),
        (SQUARE + "f 1 2 9\n", "none of its 4 vertices"),
        (SQUARE + "f 1 2 -9\n", "none of its 4 vertices"),
        (SQUARE + "f 1 1 2\n", "no area"),
    ],
)
def test_damaged_files_are_one_sentence(tmp_path, content, message):
    path = tmp_path / "bad.obj"
    path.write_text(content)
    with pytest.raises(ValueError, match=message):
        read_cloud(path)


def test_written_surfaces_come_back_with_names_and_colors(tmp_path):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.5]]) + 1e6 + 1e-6 / 3
    triangle = Patch(vertices, np.array([[0, 1, 2]], np.int32), np.tile([0.0, 0, 1], (3, 1)))
    colors = np.array([[255, 0, 51], [0, 128, 255]], np.uint8)
    path = tmp_path / "surfaces.obj"
    obj.write_surfaces(path, ["plane_0", "cone_4"], [triangle, triangle], colors)
    mesh = obj.read(path)
    np.testing.assert_allclose(mesh.vertices, np.concatenate([vertices, vertices]), atol=1e-5)
    assert mesh.faces.tolist() == [[0, 1, 2], [3, 4, 5]]
    lines = path.read_text().splitlines()
    assert lines[0] == "mtllib surfaces.mtl"
    assert [line for line in lines if line.startswith(("o ", "usemtl"))] == [
        *("o plane_0", "usemtl plane_0", "o cone_4", "usemtl cone_4")
    ]
    material = (tmp_path / "surfaces.mtl").read_text()
    assert (
        "newmtl plane_0\nKd 1.0000 0.0000 0.2000" in material and "newmtl cone_4\nKd 0.0000 0.5020 1.0000" in material
    )


def test_surfaces_open_in_trimesh(tmp_path):
    import trimesh

    triangle = Patch(np.eye(3), np.array([[0, 1, 2]], np.int32), np.full((3, 3), 3**-0.5))
    obj.write_surfaces(tmp_path / "s.obj", ["plane_0", "plane_1"], [triangle, triangle], np.full((2, 3), 9, np.uint8))
    scene = trimesh.load_scene(tmp_path / "s.obj", split_object=True)
    assert len(scene.geometry) == 2
    assert np.isclose(sum(mesh.area for mesh in scene.geometry.values()), np.sqrt(3))
