"""STL: both forms give the same triangles; what is short or another file is one sentence."""

import numpy as np
import pytest

from jprimfit.io import stl
from jprimfit.io.clouds import read_cloud
from jprimfit.io.meshes import NUM_SAMPLES

CORNERS = np.array([[[0, 0, 0], [2, 0, 0], [0, 2, 0]], [[0, 0, 1], [1, 0, 1], [0, 1, 1.5]]])


def _binary(head=b"solid but binary"):
    table = np.zeros(2, stl.RECORD)
    table["corners"] = CORNERS
    return head.ljust(80, b"\0") + np.array([2], "<u4").tobytes() + table.tobytes()


def _ascii():
    text = "solid part\n"
    for triangle in CORNERS:
        text += "facet normal 0 0 1\nouter loop\n"
        text += "".join(f"vertex {x} {y} {z:e}\n" for x, y, z in triangle) + "endloop\nendfacet\n"
    return (text + "endsolid part\n").encode()


@pytest.mark.parametrize("data", [_binary(), _binary(b"made by a CAD program"), _ascii(), _ascii().upper()])
def test_both_forms_are_sampled(tmp_path, data):
    path = tmp_path / "a.stl"
    path.write_bytes(data)
    mesh = stl.read(path)
    np.testing.assert_array_equal(mesh.vertices.reshape(-1, 3, 3), CORNERS)
    cloud = read_cloud(path)
    assert cloud.points.shape == (NUM_SAMPLES, 3) and cloud.normals is None


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (_binary()[:-1], "no whole STL file: its header announces 2 triangles, 184 bytes, and it has 183"),
        (_ascii()[:-20], "truncated"),
        (_ascii().replace(b"vertex 2", b"vertex two"), "not three numbers"),
        (b"hello", "not an STL file"),
        (b"x" * 80 + b"\0\0\0\0", "without triangles"),
        (b"solid a\nendsolid a\n", "without triangles"),
    ],
)
def test_damaged_files_are_one_sentence(tmp_path, data, message):
    path = tmp_path / "bad.stl"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=message):
        read_cloud(path)
