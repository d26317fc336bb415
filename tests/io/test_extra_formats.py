"""PCD, LAS, LAZ and E57 through the packages of the [formats] extra, and the sentence where one is not installed."""

import importlib
import sys

import numpy as np
import pytest

from jprimfit.io.clouds import read_cloud

POINTS = np.random.default_rng(0).uniform(-5, 5, size=(50, 3)).round(3)


def _write_pcd(path, encoding="ascii"):
    types = importlib.import_module("pypcd4.pypcd4")
    names = ("y", "x", "z", "normal_x", "normal_y", "normal_z")
    table = np.concatenate([POINTS[:, [1, 0, 2]], np.tile([0.0, 0, 1], (50, 1))], axis=1)
    cloud = types.PointCloud.from_points(table, names, (np.float64,) * 6)
    cloud.save(path, types.Encoding(encoding))


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd(tmp_path, encoding):
    pytest.importorskip("pypcd4")
    _write_pcd(tmp_path / "a.pcd", encoding)
    cloud = read_cloud(tmp_path / "a.pcd")
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-9)
    np.testing.assert_array_equal(cloud.normals, np.tile([0, 0, 1], (50, 1)))


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las(tmp_path, suffix):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.offsets, header.scales = np.array([4e6, 5e5, 0]), np.full(3, 1e-3)
    las = laspy.LasData(header)
    las.xyz = POINTS + [4e6, 5e5, 0]
    las.write(tmp_path / f"a.{suffix}")
    cloud = read_cloud(tmp_path / f"a.{suffix}")
    np.testing.assert_allclose(cloud.points - [4e6, 5e5, 0], POINTS, atol=1e-6)
    assert cloud.normals is None


def test_e57_takes_all_scans_in_the_common_frame(tmp_path):
    pye57 = pytest.importorskip("pye57")
    axes = ("cartesianX", "cartesianY", "cartesianZ")
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        file.write_scan_raw(dict(zip(axes, np.ascontiguousarray(POINTS.T), strict=True)))
        file.write_scan_raw(
            dict(zip(axes, np.ascontiguousarray(POINTS.T), strict=True)), translation=np.array([10.0, 0, 0])
        )
    cloud = read_cloud(tmp_path / "a.e57")
    np.testing.assert_allclose(cloud.points, np.concatenate([POINTS, POINTS + [10, 0, 0]]), atol=1e-9)


@pytest.mark.parametrize("suffix", ["pcd", "las", "laz", "e57"])
def test_damaged_files_are_one_sentence(tmp_path, suffix):
    pytest.importorskip({"pcd": "pypcd4", "e57": "pye57"}.get(suffix, "laspy"))
    path = tmp_path / f"bad.{suffix}"
    head = {"pcd": b"VERSION 0.7\nFIELDS x y z\n", "e57": b"ASTM-E57"}.get(suffix, b"LASF")
    for data in (b"garbage", head, head + bytes(range(256)) * 4):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=f"bad.{suffix}"):
            read_cloud(path)


def test_a_truncated_pcd_is_one_sentence(tmp_path):
    pytest.importorskip("pypcd4")
    _write_pcd(tmp_path / "a.pcd", "binary")
    data = (tmp_path / "a.pcd").read_bytes()
    (tmp_path / "a.pcd").write_bytes(data[: -2 * 48])
    with pytest.raises(ValueError, match="announces 50 points, 48 are there"):
        read_cloud(tmp_path / "a.pcd")


@pytest.mark.parametrize(
    ("suffix", "package"), [("pcd", "pypcd4"), ("las", "laspy"), ("laz", "laspy"), ("e57", "pye57")]
)
def test_a_missing_package_is_named(tmp_path, monkeypatch, suffix, package):
    for name in [name for name in sys.modules if name.split(".")[0] == package] + [package]:
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / f"a.{suffix}").write_bytes(b"some bytes")
    with pytest.raises(
        ValueError, match=rf"read by {package}, which is not installed: pip install 'jprimfit\[formats\]'"
    ):
        read_cloud(tmp_path / f"a.{suffix}")
