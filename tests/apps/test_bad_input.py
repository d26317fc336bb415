"""What people really feed in: a correct scene, or one sentence with exit code 2 and nothing written."""

import numpy as np
import pytest

from jprimfit.apps.main import main
from jprimfit.io import text
from jprimfit.scene import Scene

RANDOM = np.random.default_rng(0)
RADIUS, NUM = 0.5, 1024


def _plate_and_ball():
    """A plate z = 0 of 2 x 2 and, well above it, a ball of radius 0.5, 1024 points each."""
    plate = np.concatenate([RANDOM.uniform(-1, 1, size=(NUM, 2)), np.zeros((NUM, 1))], axis=1)
    rays = RANDOM.normal(size=(NUM, 3))
    ball = RADIUS * rays / np.linalg.norm(rays, axis=1, keepdims=True) + [0.1, 0.2, 1.2]
    return np.concatenate([plate, ball]) + RANDOM.normal(scale=1e-3, size=(2 * NUM, 3))


PART = _plate_and_ball()


def _refused(tmp_path, capsys, name):
    """The sentence with which the command refuses the file; nothing else may have appeared."""
    before = sorted(path.name for path in tmp_path.iterdir())
    code = main(["fit", str(tmp_path / name), "--out", str(tmp_path / "out")])
    out, err = capsys.readouterr()
    assert code == 2 and out == "" and sorted(path.name for path in tmp_path.iterdir()) == before
    last = err.splitlines()[-1]
    assert last.startswith("jprimfit: fit: ") and last.endswith(".") and "Traceback" not in err
    return last


PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 2048\nproperty double x\nproperty double y\n"
    b"property double z\nend_header\n" + PART.tobytes()
)
FILES = {
    "empty.xyz": (b"", "is empty"),
    "blank.csv": (b"\n \n", "is empty"),
    "one.xyz": (b"1 2 3\n", "1 point, 1 of them distinct"),
    "equal.xyz": (b"1 2 3\n" * 50, "50 points, 1 of them distinct"),
    "line.xyz": (b"".join(b"%d %d %d\n" % (i, 2 * i, -i) for i in range(50)), "all 50 points lie on one line"),
    "nan.xyz": (b"nan nan nan\n" * 50, "0 points, 0 of them distinct after dropping 50 rows"),
    "columns.xyz": (b"1 2\n3 4\n5 6\n", "2 numbers per point"),
    "letter.txt": (b"Dear Sir,\n\nthe scan is late.\n", "no row of numbers"),
    "cut.ply": (PLY[:-100], "is truncated"),
    "header.ply": (PLY.replace(b"double y", b"double q"), "vertices without x y z"),
    "garbage.ply": (bytes(range(256)) * 20, "is not a PLY file"),
    "garbage.stl": (bytes(range(256)) * 20, "no whole STL file"),
    "garbage.npy": (bytes(range(256)) * 20, "is not a whole NPY file"),
    "garbage.npz": (bytes(range(256)) * 20, "is not an NPZ archive"),
    "garbage.obj": (bytes(range(256)) * 20, "garbage.obj"),
    "garbage.txt": (bytes(range(256)) * 20, "binary data"),
    "scan.docx": (b"PK", "has the suffix '.docx'"),
}


@pytest.mark.parametrize("name", FILES)
def test_what_is_no_scan_is_refused_in_one_sentence(tmp_path, capsys, name):
    data, message = FILES[name]
    (tmp_path / name).write_bytes(data)
    assert message in _refused(tmp_path, capsys, name)


def test_an_absent_file_and_a_folder_are_refused(tmp_path, capsys):
    assert "does not exist" in _refused(tmp_path, capsys, "absent.ply")
    (tmp_path / "folder.ply").mkdir()
    assert "is a folder" in _refused(tmp_path, capsys, "folder.ply")


def test_an_array_of_two_columns_is_refused(tmp_path, capsys):
    np.save(tmp_path / "a.npy", np.zeros((100, 2)))
    assert "shape (100, 2)" in _refused(tmp_path, capsys, "a.npy")


def _check_answer(folder, points, *, scale=1.0, offset=0.0):
    """The plate and the ball must be there, in the unit and frame of the input, with nearly all of their points."""
    scene = Scene.load(folder / "scene.json")
    np.testing.assert_array_equal(scene.points, points)
    assert scene.labels.shape == (len(points),) and set(scene.labels.tolist()) <= set(range(-1, len(scene.primitives)))
    finite = np.all(np.isfinite(points), axis=1)
    assert np.all(scene.labels[~finite] == -1) and np.mean(scene.labels[finite] >= 0) > 0.95
    assert np.all(scene.counts() > 0)
    counts = scene.counts()
    plane = max((i for i, p in enumerate(scene.primitives) if p.kind == "plane"), key=counts.__getitem__)
    sphere = max((i for i, p in enumerate(scene.primitives) if p.kind == "sphere"), key=counts.__getitem__)
    assert counts[plane] > 0.9 * NUM and counts[sphere] > 0.9 * NUM
    plate, ball = scene.primitives[plane], scene.primitives[sphere]
    np.testing.assert_allclose(plate.normal, [0, 0, 1], atol=2e-3)
    np.testing.assert_allclose((plate.normal @ np.full(3, offset) - plate.offset) / scale, 0, atol=3e-3)
    np.testing.assert_allclose(ball.radius / scale, RADIUS, atol=2e-3)
    np.testing.assert_allclose((ball.center - offset) / scale, [0.1, 0.2, 1.2], atol=2e-3)
    labelled = scene.labels >= 0
    assert np.all(np.isnan(scene.distances[~labelled])) and np.all(scene.distances[labelled] >= 0)
    assert np.median(scene.distances[labelled]) / scale < 2e-3


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1.0, 1e6), (1e-6, 0.0), (1e3, -2e6)])
def test_unit_and_position_do_not_matter(light, tmp_path, scale, offset):
    points = PART * scale + offset
    np.save(tmp_path / "part.npy", points)
    assert main(["fit", str(tmp_path / "part.npy"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    _check_answer(tmp_path / "out", points, scale=scale, offset=offset)


def test_rows_that_are_not_finite_have_no_label(light, tmp_path):
    points = PART.copy()
    points[::97] = np.nan
    points[5], points[1500, 1] = np.inf, -np.inf
    text.write(tmp_path / "part.xyz", points)
    assert main(["fit", str(tmp_path / "part.xyz"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    _check_answer(tmp_path / "out", points)


@pytest.mark.parametrize("num_points", [4, 12])
def test_a_dozen_points_give_a_scene_or_a_sentence(light, tmp_path, capsys, num_points):
    text.write(tmp_path / "few.xyz", np.random.default_rng(1).normal(size=(num_points, 3)))
    if main(["fit", str(tmp_path / "few.xyz"), "--out", str(tmp_path / "out"), "--quiet"]) == 0:
        scene = Scene.load(tmp_path / "out" / "scene.json")
        assert scene.labels.shape == (num_points,) and np.all(scene.counts() > 0)
    else:
        assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "out").exists()
