"""NPY and NPZ: shapes and names that are clear are read, objects are never unpickled."""

import io

import numpy as np
import pytest

from jprimfit.io import numpy_files
from jprimfit.io.clouds import read_cloud

RANDOM = np.random.default_rng(0)
POINTS = RANDOM.normal(size=(20, 3))
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.dtype(">f4"), np.int16])
def test_npy_of_any_number_type(tmp_path, dtype):
    array = (100 * POINTS).astype(dtype)
    np.save(tmp_path / "a.npy", array)
    cloud = read_cloud(tmp_path / "a.npy")
    np.testing.assert_array_equal(cloud.points, array.astype(np.float64))
    assert cloud.points.dtype == np.float64 and cloud.normals is None


def test_six_columns_and_records_carry_normals(tmp_path):
    np.save(tmp_path / "a.npy", np.concatenate([POINTS, NORMALS], axis=1))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npy").normals, NORMALS)
    table = np.zeros(20, [(name, "f8") for name in ("ny", "x", "z", "nx", "y", "nz")])
    for i, letter in enumerate("xyz"):
        table[letter], table["n" + letter] = POINTS[:, i], NORMALS[:, i]
    np.save(tmp_path / "b.npy", table)
    np.testing.assert_array_equal(read_cloud(tmp_path / "b.npy").points, POINTS)
    np.testing.assert_array_equal(read_cloud(tmp_path / "b.npy").normals, NORMALS)


@pytest.mark.parametrize("key", ["points", "xyz", "arr_0", "my_scan"])
def test_npz_by_name_or_as_the_only_fitting_array(tmp_path, key):
    np.savez(tmp_path / "a.npz", **{key: POINTS, "normals_of_all": np.zeros(4), "normals": NORMALS})
    if key == "my_scan":
        np.savez(tmp_path / "a.npz", **{key: POINTS, "other": np.zeros(4)})
    cloud = read_cloud(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert (cloud.normals is not None) == (key != "my_scan")


class Dangerous:
    """Unpickling it would fail the test."""

    def __reduce__(self):
        return (pytest.fail, ("a file was unpickled",))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((5, 2)), r"shape \(5, 2\)"),
        (np.zeros((3, 500)), "save its transpose"),
        (np.zeros(9), r"shape \(9,\)"),
        (np.zeros((2, 5, 3)), r"shape \(2, 5, 3\)"),
        (np.zeros((0, 3)), "holds no points"),
        (np.full((5, 3), "x"), "type <U1"),
        (np.zeros((5, 3), complex), "type complex128"),
        (np.full((5, 3), Dangerous(), object), "Python objects|not a whole NPZ"),
    ],
)
@pytest.mark.parametrize("kind", ["npy", "npz"])
def test_other_arrays_are_one_sentence(tmp_path, array, message, kind):
    path = tmp_path / f"bad.{kind}"
    np.save(path, array) if kind == "npy" else np.savez(path, points=array)
    with pytest.raises(ValueError, match=message):
        read_cloud(path)


def test_damaged_files_are_one_sentence(tmp_path):
    np.save(tmp_path / "a.npy", POINTS)
    data = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(data[:-8])
    with pytest.raises(ValueError, match="truncated"):
        read_cloud(tmp_path / "a.npy")
    (tmp_path / "a.npy").write_bytes(data.replace(b"(20, 3)", b"(9999999999999, 3)"))
    with pytest.raises(ValueError, match="truncated|not a whole NPY"):
        read_cloud(tmp_path / "a.npy")
    np.savez(tmp_path / "a.npz", points=POINTS)
    data = (tmp_path / "a.npz").read_bytes()
    for damaged in (data[: len(data) // 2], data[:100] + b"\xff" * 50 + data[150:], b"PK\x03\x04" + b"\x00" * 40):
        (tmp_path / "a.npz").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a\.npz"):
            read_cloud(tmp_path / "a.npz")


def test_ambiguous_archives_name_what_they_hold(tmp_path):
    np.savez(tmp_path / "a.npz", first=POINTS, second=POINTS)
    with pytest.raises(ValueError, match="holds the arrays first, second, none of which is clearly the points"):
        read_cloud(tmp_path / "a.npz")


def test_archives_are_the_same_bytes_every_time():
    arrays = {"points": POINTS, "labels": np.arange(20)}
    data = numpy_files.npz_bytes(arrays)
    assert data == numpy_files.npz_bytes(arrays)
    np.testing.assert_array_equal(np.load(io.BytesIO(data))["labels"], np.arange(20))
