"""Answers appear whole or not at all."""

import numpy as np
import pytest

from jprimfit.apps.outputs import check_target, staged, write_outputs
from jprimfit.scene import Scene
from jprimfit.types import Plane


def _names(folder):
    return sorted(path.name for path in folder.iterdir())


def _square(num_lost=0):
    """A plate of 400 points, and a second plane that only `num_lost` of them belong to."""
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 20), np.linspace(0, 1, 20)), axis=-1).reshape(-1, 2)
    points = np.concatenate([grid, np.zeros((400, 1))], axis=1)
    labels = np.zeros(400, np.int32)
    labels[:num_lost] = 1
    up = np.array([0.0, 0, 1])
    primitives = (Plane(up, np.float64(0)), Plane(up, np.float64(0)))[: 1 + (num_lost > 0)]
    surfaces = np.zeros(len(primitives), np.int32)
    return Scene(points, labels, primitives, surfaces, np.tile(up, (400, 1)), np.zeros(400))


def _rest(scene):
    return scene.primitives, scene.surface_of, scene.normals, scene.distances


def test_a_scene_gives_every_file(tmp_path):
    from jprimfit.cad import step

    assert write_outputs(_square(), tmp_path / "out", title="plate") == []
    expected = ["deviations.ply", "features.csv", "report.png", "scene.json", "scene.npz"]
    expected += ["segments.ply", "surfaces.mtl", "surfaces.obj"]
    assert _names(tmp_path / "out") == sorted(expected + ["surfaces.step"] * step.available())
    assert (tmp_path / "out" / "report.png").read_bytes()[:4] == b"\x89PNG"
    assert "o plane_0\n" in (tmp_path / "out" / "surfaces.obj").read_text()


def test_deviations_are_colored_by_sign(quick, tmp_path):
    flat = _square()
    points = flat.points + np.array([0, 0, 1]) * np.where(np.arange(400) % 2, 0.01, -0.01)[:, None]
    points[0, 2], points[1, 2] = -0.5, 0.5
    scene = Scene(points, np.where(np.arange(400) == 9, -1, 0).astype(np.int32), *_rest(flat))
    write_outputs(scene, tmp_path / "out")
    header, data = (tmp_path / "out" / "deviations.ply").read_bytes().split(b"end_header\n")
    row = np.frombuffer(data, [("xyz", "<f8", 3), ("rgb", "u1", 3), ("deviation", "<f4"), ("label", "<i4")])
    scale = 3 * np.sqrt(np.nanmean(scene.signed_distances**2))
    assert f"blue {-scale:.6g} or less, white 0, red {scale:.6g} or more".encode() in header
    np.testing.assert_allclose(row["deviation"], np.where(scene.labels == 0, points[:, 2], np.nan), atol=1e-7)
    (blue, red, _, nearly_white), grey = row["rgb"][:4].astype(int), row["rgb"][9]
    assert blue[2] > blue[0] + 80 and red[0] > red[2] + 80 and nearly_white.min() > 180 and len(set(grey.tolist())) == 1


def test_colors_and_kinds_agree_between_the_files(quick, tmp_path):
    scene = _square(num_lost=1)
    notes = write_outputs(scene, tmp_path / "out")
    assert notes == ["surfaces.obj lacks plane_1 (too few points to trim it to)"]
    data = (tmp_path / "out" / "segments.ply").read_bytes().split(b"end_header\n")[1]
    row = np.frombuffer(data, [("xyz", "<f8", 3), ("n", "<f4", 3), ("rgb", "u1", 3), ("label", "<i4"), ("kind", "i1")])
    np.testing.assert_array_equal(row["label"], scene.labels)
    assert set(row["kind"].tolist()) == {0}
    color = (tmp_path / "out" / "surfaces.mtl").read_text().split("Kd ")[1].split("\n")[0]
    np.testing.assert_allclose(np.array(color.split(), float), row["rgb"][-1] / 255, atol=1e-4)


def test_a_failure_leaves_no_trace(tmp_path):
    with pytest.raises(RuntimeError), staged(tmp_path / "a" / "b" / "out") as place:
        (place / "scene.json").write_text("half")
        raise RuntimeError
    assert _names(tmp_path) == []
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "scene.json").write_text("old")
    with pytest.raises(KeyboardInterrupt), staged(tmp_path / "out") as place:
        (place / "scene.json").write_text("half")
        raise KeyboardInterrupt
    assert _names(tmp_path) == ["out"] and (tmp_path / "out" / "scene.json").read_text() == "old"


def test_nothing_shows_under_the_name_before_all_is_written(tmp_path):
    with staged(tmp_path / "out") as place:
        (place / "scene.json").write_text("new")
        assert not (tmp_path / "out").exists()
    assert _names(tmp_path) == ["out"]


def test_targets_are_checked(tmp_path, monkeypatch):
    check_target(tmp_path / "new" / "deeper")
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is a file: give a folder"):
        check_target(tmp_path / "file")
    with pytest.raises(ValueError, match="cannot be written"):
        check_target(tmp_path / "file" / "below")
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(ValueError, match="cannot be written"):
        check_target(tmp_path / "new")
