"""`jprimfit fit`: its files, its tables, its settings, one scan or many."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jprimfit.apps.fit import Outcome, answer_text
from jprimfit.apps.main import main
from jprimfit.io import text
from jprimfit.io.clouds import read_cloud
from jprimfit.networks import weights
from jprimfit.scene import Scene
from jprimfit.types import Plane

POINTS = np.random.default_rng(0).normal(size=(60, 3))
FILES = [
    *("deviations.ply", "features.csv", "report.png", "scene.json", "scene.npz"),
    *("segments.ply", "surfaces.mtl", "surfaces.obj"),
]


@pytest.fixture
def scan(tmp_path):
    text.write(tmp_path / "part.xyz", POINTS)
    return tmp_path / "part.xyz"


def _names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_one_scan_gives_the_files_and_the_table(quick, scan, tmp_path, capsys):
    assert main(["fit", str(scan), "--out", str(tmp_path / "deep" / "out")]) == 0
    out, err = capsys.readouterr()
    assert _names(tmp_path / "deep") == ["out"] and _names(tmp_path / "deep" / "out") == FILES
    assert (
        "plane" in out and "sphere" in out and "d 2.0" in out and "100.0 % of 60 points" in out and "noise 0.25" in out
    )
    assert "60 points" in err and err.count("growing") == 1
    scene = Scene.load(tmp_path / "deep" / "out" / "scene.json")
    np.testing.assert_array_equal(scene.points, POINTS)
    np.testing.assert_array_equal(read_cloud(tmp_path / "deep" / "out" / "segments.ply").points, POINTS)
    assert quick[0]["model"] == "default" and quick[0]["filter"] == "auto" and quick[0]["smooth"] is False


def test_settings_reach_the_pipeline(quick, scan, tmp_path, capsys):
    words = ["--filter", "on", "--smooth", "on", "--no-network", "--seed", "7", "--quiet"]
    assert main(["fit", str(scan), "--out", str(tmp_path / "out"), *words]) == 0
    assert capsys.readouterr() == ("", "")
    call = quick[0]
    assert (call["filter"], call["smooth"], call["model"], call["seed"]) == ("on", True, None, 7)
    assert call["min_points"] == 6 and "tolerance" not in call and "kinds" not in call and "labels" not in call


def test_wishes_reach_the_pipeline(quick, scan, tmp_path):
    words = ["--tolerance", "0.5", "--min-points", "9", "--kinds", "plane,cone", "--device", "cpu", "--quiet"]
    assert main(["fit", str(scan), "--out", str(tmp_path / "out"), *words]) == 0
    call = quick[0]
    assert (call["tolerance"], call["min_points"], call["kinds"]) == (0.5, 9, ["plane", "cone"])


def test_labels_are_those_of_one_scan(quick, scan, tmp_path, capsys):
    np.save(tmp_path / "labels.npy", np.zeros(60, int))
    words = ["fit", str(scan), str(scan), "--labels", str(tmp_path / "labels.npy"), "--out", str(tmp_path / "out")]
    assert main(words) == 2 and not quick
    assert "one scan" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["default", "nonsense"])
def test_a_network_and_none_exclude_each_other(quick, scan, tmp_path, capsys, name):
    with pytest.raises(SystemExit) as refusal:
        main(["fit", str(scan), "--out", str(tmp_path / "out"), "--no-network", "--model", name])
    assert refusal.value.code == 2 and "--model: not allowed with argument --no-network" in capsys.readouterr().err
    assert not quick


@pytest.mark.parametrize("scans", [1, 2])
def test_a_model_is_read_once_and_refused_before_the_scans(quick, scan, tmp_path, capsys, scans):
    words = ["fit", *[str(scan)] * scans, "--out", str(tmp_path / "out"), "--quiet"]
    assert main([*words, "--model", "nonsense"]) == 2 and not quick
    assert capsys.readouterr().err.startswith("jprimfit: fit: 'nonsense' is no model")
    assert main([*words, "--model", ""]) == 2 and not quick
    shipped = weights.load("default")
    weights.save(tmp_path / "mine", shipped._replace(name="mine"))
    assert main([*words, "--model", str(tmp_path / "mine")]) == 0
    assert [call["model"].name for call in quick] == ["mine"] * scans
    assert quick[0]["model"] is quick[-1]["model"]


def test_several_scans_have_folders_of_their_own_and_a_summary(quick, tmp_path, capsys):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        text.write(tmp_path / folder / "part.xyz", POINTS)
    text.write(tmp_path / "Part.csv", POINTS)
    bad = tmp_path / "bad.ply"
    bad.write_bytes(b"nothing")
    scans = [tmp_path / "a" / "part.xyz", bad, tmp_path / "b" / "part.xyz", tmp_path / "Part.csv"]
    assert main(["fit", *map(str, scans), "--out", str(tmp_path / "out")]) == 2
    out, err = capsys.readouterr()
    assert _names(tmp_path / "out") == ["Part-3", "part", "part-2"]
    assert all(_names(folder) == FILES for folder in (tmp_path / "out").iterdir())
    assert f"jprimfit: fit: {bad} is not a PLY file" in err
    lines = out.splitlines()
    assert len(lines) == 6 and "failed:" in lines[3] and "1 plane, 1 sphere" in lines[2]


def test_a_folder_that_cannot_be_written_does_not_stop_the_others(quick, tmp_path, capsys):
    for name in ("a", "b"):
        text.write(tmp_path / f"{name}.xyz", POINTS)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a").write_text("mine")
    assert main(["fit", str(tmp_path / "a.xyz"), str(tmp_path / "b.xyz"), "--out", str(tmp_path / "out")]) == 2
    assert "is a file: give a folder" in capsys.readouterr().err
    assert (tmp_path / "out" / "a").read_text() == "mine" and _names(tmp_path / "out" / "b") == FILES


@pytest.mark.parametrize("primitives", [0, 1])
def test_points_left_out_are_told(primitives):
    report = {"num_unusable": 1200, "preprocessing": {"num_removed": 3}}
    planes, labels = (Plane(np.eye(3)[2], np.float64(0)),) * primitives, np.full(60, primitives - 1, np.int32)
    scene = Scene(POINTS, labels, planes, np.arange(primitives, dtype=np.int32), POINTS, np.zeros(60), report=report)
    outcome = Outcome(Path("scan.ply"), Path("out"), scene, 1.0, "")
    assert "points left out: 1,200 not finite, 3 removed as outliers (see --filter)" in answer_text(outcome)
    assert "left out" not in answer_text(outcome._replace(scene=replace(scene, report={})))


def test_a_scan_that_is_refused_writes_nothing(quick, tmp_path, capsys):
    text.write(tmp_path / "line.xyz", np.linspace(0, 1, 20)[:, None] * [1.0, 2, 3])
    assert main(["fit", str(tmp_path / "line.xyz"), "--out", str(tmp_path / "new" / "out")]) == 2
    assert "line.xyz: all 20 points lie on one line" in capsys.readouterr().err
    assert _names(tmp_path) == ["line.xyz"]


@pytest.mark.parametrize("place", ["file", "file/below"])
def test_a_target_that_cannot_be_is_refused_before_the_work(quick, scan, tmp_path, capsys, place):
    (tmp_path / "file").write_text("mine")
    assert main(["fit", str(scan), "--out", str(tmp_path / place)]) == 2
    assert "give a folder" in capsys.readouterr().err or place != "file"
    assert quick == [] and (tmp_path / "file").read_text() == "mine"


def test_files_of_others_stay_and_old_answers_go(quick, scan, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("notes.txt", "surfaces.step", "scene.json"):
        (out / name).write_text("old")
    assert main(["fit", str(scan), "--out", str(out), "--quiet"]) == 0
    assert _names(out) == sorted([*FILES, "notes.txt"])
    assert (out / "notes.txt").read_text() == "old" and Scene.load(out / "scene.json").labels.shape == (60,)
