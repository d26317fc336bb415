"""The Fit4CAD reader on a file of a few points, and on files that are none of its."""

import h5py
import numpy as np
import pytest

from jprimfit.data.fit4cad import SOURCE_KINDS, read_clouds

POINTS = np.arange(18, dtype=np.float32).reshape(6, 3)


def group(file, name, *, points=POINTS, **changes):
    """Writes one cloud: a plane {0, 1, 2}, half a cylinder {2, 3}, its other half {4, 5}, an empty torus."""
    arrays = {
        "points": points,
        "member_ptr": np.array([0, 3, 5, 7, 7]),
        "member_index": np.array([0, 1, 2, 2, 3, 4, 5], np.int32),
        "inst_type": np.array([1, 2, 2, 5], np.int8),
        "inst_surface": np.array([0, 1, 1, 2], np.int16),
        "inst_params": np.arange(32.0).reshape(4, 8),
    }
    for array, values in (arrays | changes).items():
        if values is not None:
            file.create_dataset(f"{name}/{array}", data=values)


@pytest.fixture
def benchmark(tmp_path):
    path = tmp_path / "clouds.h5"
    with h5py.File(path, "w") as file:
        for name in ("PC010", "PC002", "PC1000"):
            group(file, name)
        file["notes"] = np.arange(3)
    return path


def test_clouds_come_in_order_of_their_numbers(benchmark):
    assert [cloud.name for cloud in read_clouds(benchmark)] == ["PC002", "PC010", "PC1000"]
    assert [cloud.name for cloud in read_clouds(benchmark, first=3, last=10)] == ["PC010"]
    assert list(read_clouds(benchmark, first=11, last=999)) == []


def test_members_are_sets_of_rows_that_may_share_points(benchmark):
    cloud = next(read_clouds(benchmark))
    assert cloud.points.dtype == np.float64
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert [rows.tolist() for rows in cloud.members] == [[0, 1, 2], [2, 3], [4, 5], []]
    assert cloud.kinds == ("plane", "cylinder", "cylinder", "torus")
    np.testing.assert_array_equal(cloud.surfaces, [0, 1, 1, 2])
    np.testing.assert_array_equal(cloud.radii, [np.nan, 14, 22, np.nan])  # of the cylinders only
    assert set(cloud.kinds) < set(SOURCE_KINDS)


def refused(path):
    with pytest.raises(ValueError) as error:
        list(read_clouds(path))
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    return str(error.value)


def test_files_of_others_are_refused(tmp_path):
    assert "not a file" in refused(tmp_path / "absent.h5")
    text = tmp_path / "text.h5"
    text.write_text("x y z\n0 0 0\n")
    assert "damaged or no HDF5" in refused(text)
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["PCx/points"] = POINTS
        file["scan"] = POINTS
    assert "no group PC<number>" in refused(other)


@pytest.mark.parametrize(
    "changes",
    [
        {"member_index": None},
        {"points": POINTS[:, :2]},
        {"points": POINTS.astype(int)},
        {"inst_type": np.array([0.5, 1, 2, 3])},
        {"member_ptr": np.zeros((2, 2), int)},
    ],
)
def test_a_cloud_that_lacks_or_distorts_an_array_is_refused(tmp_path, changes):
    path = tmp_path / "clouds.h5"
    with h5py.File(path, "w") as file:
        group(file, "PC001", **changes)
    assert f"PC001/{next(iter(changes))}" in refused(path)
