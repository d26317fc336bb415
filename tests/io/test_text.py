"""Text columns: separators, headers, comments and decimal commas of the programs that export scans."""

import numpy as np
import pytest

from jprimfit.io import text
from jprimfit.io.clouds import read_cloud

POINTS = np.array([[1.5, 2.0, 3.0], [4.0, 5.25, 6.0], [7.0, 8.0, -9.5], [0.0, 1e-3, 2e5]])
NORMALS = np.array([[0, 0, 1.0], [0, 1, 0], [0.6, 0.8, 0], [1, 0, 0]])
ROWS = [" ".join(map(repr, row)) for row in POINTS.tolist()]


def _join(rows, mark=" ", end="\n"):
    return end.join(row.replace(" ", mark) for row in rows) + end


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.xyz", _join(ROWS)),
        ("a.xyz", _join(ROWS, end="\r\n")),
        ("a.xyz", "\ufeff" + _join(ROWS)),
        ("a.csv", _join(ROWS, ",")),
        ("a.csv", _join(ROWS, ", ")),
        ("a.csv", "x,y,z\n" + _join(ROWS, ",")),
        ("a.csv", '"x","y","z"\n' + "".join(f'"{a}","{b}","{c}"\n' for a, b, c in POINTS.tolist())),
        ("a.csv", "X [mm];Y [mm];Z [mm]\n" + _join(ROWS, ";").replace(".", ",")),
        ("a.txt", "# scan of a part\n\n// more\n" + _join(ROWS, "\t")),
        ("a.txt", "Exported by a scanner, version 3\nunit: mm\n" + _join(ROWS)),
        ("a.txt", _join([row + " # good" for row in ROWS])),
        ("a.asc", _join([row + " 255 0 17" for row in ROWS])),
        ("a.pts", "4\n" + _join([row + " -1200 10 20 30" for row in ROWS])),
        ("a.csv", _join(ROWS, ",", end=",\n")),
        (
            "a.csv",
            "id,z,intensity,x,y\n" + "".join(f"{i},{c},9,{a},{b}\n" for i, (a, b, c) in enumerate(POINTS.tolist())),
        ),
        ("A.XYZ", _join(ROWS)),
    ],
)
def test_points_of_many_dialects(tmp_path, name, content):
    (tmp_path / name).write_text(content, encoding="utf-8")
    cloud = read_cloud(tmp_path / name)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.normals is None


def test_utf16_is_read(tmp_path):
    (tmp_path / "a.txt").write_text(_join(ROWS), encoding="utf-16")
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.txt").points, POINTS)


@pytest.mark.parametrize("colors", ["", "10 20 30 "])
def test_six_columns_are_normals_only_where_they_have_unit_length(tmp_path, colors):
    path = tmp_path / "a.xyz"
    path.write_text("".join(f"{p} {colors}{n[0]} {n[1]} {n[2]}\n" for p, n in zip(ROWS, NORMALS, strict=True)))
    np.testing.assert_array_equal(read_cloud(path).normals, NORMALS)
    path.write_text("".join(f"{p} {colors}{2 * n[0]} {n[1]} {n[2]}\n" for p, n in zip(ROWS, NORMALS, strict=True)))
    assert read_cloud(path).normals is None


def test_named_normals_are_taken_by_name(tmp_path):
    path = tmp_path / "a.csv"
    rows = np.concatenate([NORMALS[:, ::-1], POINTS], axis=1).tolist()
    path.write_text("//Nz,Ny,Nx,X,Y,Z\n" + "".join(",".join(map(repr, row)) + "\n" for row in rows))
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.normals, NORMALS)


def test_nan_rows_are_kept_for_the_checks(tmp_path):
    (tmp_path / "a.xyz").write_text(_join([*ROWS, "nan nan nan", "inf 0 1"]))
    assert read_cloud(tmp_path / "a.xyz").points.shape == (6, 3)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b" \n\n", "is empty"),
        (b"Dear Sir,\nthe scan is late.\n", "no row of numbers"),
        (b"1 2\n3 4\n5 6\n", "2 numbers per point, but x y z"),
        (b"7\n8\n9\n", "1 number per point"),
        (b"1 2 3\n4 5\n6 7 8\n", r"line 2 \('4 5'\)"),
        (b"x y z\n1 2 3\n4 5 six\n", r"line 3 \('4 5 six'\)"),
        (b"1,2,3\n4,,6\n", "line 2"),
        (b"1 2 3\n\x00\x01\x02", "binary data"),
    ],
)
def test_what_is_no_cloud_is_one_sentence(tmp_path, content, message):
    path = tmp_path / "bad.txt"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_cloud(path)


@pytest.mark.parametrize("normals", [None, NORMALS])
def test_written_text_comes_back(tmp_path, normals):
    points = np.random.default_rng(0).normal(size=(4, 3)) + 1e6
    text.write(tmp_path / "a.xyz", points, normals)
    cloud = read_cloud(tmp_path / "a.xyz")
    np.testing.assert_array_equal(cloud.points, points)
    assert (cloud.normals is None) == (normals is None)
