"""PLY: every encoding and order gives the same cloud; what the header promises and the body lacks is one sentence."""

import numpy as np
import pytest

from jprimfit.io import ply
from jprimfit.io.clouds import read_cloud

POINTS = np.array([[0.5, -1.25, 2.0], [3.0, 4.5, -6.0], [7.0, 8.0, 9.0], [0.0, 0.25, 1e6]])
NORMALS = np.array([[0, 0, 1], [0, 1, 0], [1, 0, 0], [0.6, 0.8, 0]])
HEADER = "ply\nformat {} 1.0\ncomment made by hand\n"


def _binary(order, *, points=POINTS):
    """Properties out of order, an element before the vertices with a list, extra properties, an element behind."""
    header = HEADER.format({"<": "binary_little_endian", ">": "binary_big_endian"}[order])
    header += "element camera 2\nproperty list uchar short views\nproperty double f\n"
    header += f"element vertex {len(points)}\nproperty float nz\nproperty double z\nproperty uchar red\n"
    header += "property double x\nproperty float nx\nproperty double y\nproperty float ny\n"
    header += "element tail 5\nproperty list int int rest\nend_header\n"
    body = b""
    for views in ([1, 2, 3], [4]):
        body += np.array([len(views)], "u1").tobytes() + np.array(views, order + "i2").tobytes()
        body += np.array([0.5], order + "f8").tobytes()
    fields = [("nz", "f4"), ("z", "f8"), ("red", "u1"), ("x", "f8"), ("nx", "f4"), ("y", "f8"), ("ny", "f4")]
    table = np.zeros(len(points), [(name, order + code) for name, code in fields])
    for i, letter in enumerate("xyz"):
        table[letter], table["n" + letter] = points[:, i], NORMALS[:, i]
    return header.encode() + body + table.tobytes()


def _ascii(points=POINTS):
    header = (
        HEADER.format("ascii") + "obj_info none\nelement camera 2\nproperty list uchar short views\nproperty double f\n"
    )
    header += f"element vertex {len(points)}\nproperty double y\nproperty double x\nproperty int extra\n"
    header += "property double z\nproperty float nx\nproperty float ny\nproperty float nz\nend_header\n"
    rows = [f"{p[1]!r} {p[0]!r} 7 {p[2]!r} {n[0]} {n[1]} {n[2]}" for p, n in zip(points.tolist(), NORMALS, strict=True)]
    return (header + "3 1 2 3 0.5\n1 4 0.5\n" + "\n".join(rows) + "\n").encode()


@pytest.mark.parametrize("data", [_binary("<"), _binary(">"), _ascii(), _ascii().replace(b"\n", b"\r\n")])
def test_every_encoding_gives_points_and_normals(tmp_path, data):
    (tmp_path / "a.ply").write_bytes(data)
    cloud = read_cloud(tmp_path / "a.ply")
    assert cloud.points.dtype == np.float64
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-7)


@pytest.mark.parametrize("corners", [[3, 3, 3], [4, 4], [3, 4, 5]])
@pytest.mark.parametrize("order", ["ascii", "<", ">"])
def test_polygons_become_fans(tmp_path, corners, order):
    polygons = [np.arange(n) for n in corners]
    vertices = np.random.default_rng(0).normal(size=(5, 3))
    name = {"ascii": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = HEADER.format(name) + "element vertex 5\nproperty double x\nproperty double y\nproperty double z\n"
    header += f"element face {len(corners)}\nproperty list uchar int vertex_indices\nproperty uchar flag\nend_header\n"
    if order == "ascii":
        body = "\n".join(" ".join(map(repr, row)) for row in vertices.tolist()) + "\n"
        body = (body + "\n".join(f"{len(p)} {' '.join(map(str, p))} 9" for p in polygons)).encode()
    else:
        body = vertices.astype(order + "f8").tobytes()
        for p in polygons:
            body += bytes([len(p)]) + p.astype(order + "i4").tobytes() + b"\x09"
    path = tmp_path / "mesh.ply"
    path.write_bytes(header.encode() + body)
    mesh = ply.read(path)
    expected = [[0, i, i + 1] for n in corners for i in range(1, n - 1)]
    assert sorted(mesh.faces.tolist()) == sorted(expected)
    np.testing.assert_array_equal(mesh.vertices, vertices)


@pytest.mark.parametrize("data", [_binary("<"), _binary(">"), _ascii()])
def test_truncation_is_one_sentence(tmp_path, data):
    path = tmp_path / "cut.ply"
    path.write_bytes(data[:-40])
    with pytest.raises(ValueError, match="cut.ply is truncated: its header announces 4 vertex rows|holds a vertex row"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"property double x", b"property double u", "vertices without x y z"),
        (b"property double x", b"property quad x", "PLY header whose line"),
        (b"element vertex 4", b"element vertex four", "PLY header whose line"),
        (b"element vertex 4", b"element vertex 4000000000000", "truncated"),
        (b"format ascii 1.0", b"format utf8 1.0", "PLY header whose line"),
        (b"format ascii 1.0\n", b"", "without a format line"),
        (b"end_header", b"end_of_it", "not a PLY file"),
        (b"element vertex 4", b"element vertex 0", "without vertices"),
        (b"-1.25", b"west", "holds a vertex row that is not 7 numbers"),
        (b"3 1 2 3 0.5", b"9 1 2 3 0.5", "camera row that does not fit"),
        (b"property list uchar", b"property list float", "PLY header whose line"),
    ],
)
def test_a_wrong_header_or_row_is_one_sentence(tmp_path, old, new, message):
    assert old in _ascii()
    path = tmp_path / "bad.ply"
    path.write_bytes(_ascii().replace(old, new))
    with pytest.raises(ValueError, match=message):
        read_cloud(path)


def test_written_segments_come_back(tmp_path):
    path = tmp_path / "segments.ply"
    points = POINTS + 1e6
    labels, kinds = np.array([0, 1, -1, 0], np.int32), np.array([2, 0, -1, 2], np.int32)
    colors = np.arange(12, dtype=np.uint8).reshape(4, 3)
    ply.write_segments(path, points, NORMALS, colors, labels, kinds)
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, points)
    np.testing.assert_allclose(cloud.normals, NORMALS, atol=1e-7)
    header, body = path.read_bytes().split(b"end_header\n")
    assert b"property uchar red" in header and b"property int label" in header and b"property char kind" in header
    row = np.frombuffer(body, [("xyz", "<f8", 3), ("n", "<f4", 3), ("rgb", "u1", 3), ("label", "<i4"), ("kind", "i1")])
    np.testing.assert_array_equal(row["label"], labels)
    np.testing.assert_array_equal(row["kind"], kinds)
    np.testing.assert_array_equal(row["rgb"], colors)
