"""`jprimfit evaluate --protocol fit4cad` on a benchmark of two tiny clouds."""

import json

import h5py
import numpy as np
import pytest

from jprimfit.apps.main import main

COMMAND = ("evaluate", "--protocol", "fit4cad", "--method", "geometry")


def corner(num=14):
    """A floor and a wall that share the points of one edge, a knot of free form beside them, and the rows of each."""
    u, v = (axis.ravel() / num for axis in np.meshgrid(np.arange(num), np.arange(num), indexing="ij"))
    points = np.concatenate([np.stack([u, v, 0 * u], axis=1), np.stack([0 * u, v, u], axis=1)[num:]])
    on = [np.flatnonzero(points[:, axis] == 0) for axis in (2, 0)]
    knot = np.random.default_rng(0).normal(size=(9, 3)) * 0.1 + 0.6
    return np.concatenate([points, knot]), [*on, len(points) + np.arange(9)]


@pytest.fixture
def benchmark(tmp_path):
    path = tmp_path / "clouds.h5"
    points, members = corner()
    with h5py.File(path, "w") as file:
        for number, size in ((1, 1.0), (7, 30.0)):
            group = file.create_group(f"PC{number:03d}")
            group["points"] = size * points
            group["member_ptr"] = np.cumsum([0, *(len(rows) for rows in members)])
            group["member_index"] = np.concatenate(members)
            group["inst_type"] = np.array([1, 1, 0])
            group["inst_surface"] = np.array([0, 1, 2])
            group["inst_params"] = np.zeros((3, 8))
    return path


def test_a_line_per_cloud_the_mean_and_the_json(benchmark, tmp_path, capsys):
    goal = tmp_path / "scores.json"
    assert main([*COMMAND, "--data", str(benchmark), "--json", str(goal)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["PC001", "PC007", "mean"]
    assert lines[-1].startswith("mean 2") and "kind 1.000" in lines[-1] and "surfaces 2/3" in lines[-1]
    scores = json.loads(goal.read_text())
    assert [part["name"] for part in scores["parts"]] == ["PC001", "PC007"]
    for key in ("dsc_surfaces", "miou_surfaces", "kind_accuracy", "points"):
        assert scores["mean"][key] == pytest.approx(np.mean([part[key] for part in scores["parts"]]))
    # The edge belongs to both planes in the truth and to one in the answer: 14 points of 196.
    assert scores["mean"]["dsc_surfaces"] == pytest.approx((1 + 2 * 182 / (182 + 196)) / 2)
    assert scores["mean"]["miou_surfaces"] == scores["mean"]["left_of_others"] == 1
    assert scores["mean"]["dsc_single"] == pytest.approx(2 / 3)
    assert scores["mean"]["ceiling"] == scores["mean"]["dsc_surfaces"] and scores["mean"]["radius_error"] is None
    assert scores["changes"] == {"rotate": False, "noise": 0.0, "thin": 100.0, "outliers": 0.0}


def test_clouds_are_chosen_by_number_and_step(benchmark, capsys):
    assert main([*COMMAND, "--data", str(benchmark), "--clouds", "2-10"]) == 0
    assert capsys.readouterr().out.split()[0] == "PC007"
    assert main([*COMMAND, "--data", str(benchmark), "--every", "2"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["PC001", "mean"]


def test_rotation_and_noise_are_the_same_in_every_run(benchmark, capsys, tmp_path):
    scores = []
    for number in range(2):
        goal = tmp_path / f"{number}.json"
        words = ["--clouds", "1-1", "--rotate", "--noise", "0.2", "--thin", "90", "--outliers", "2"]
        assert main([*COMMAND, "--data", str(benchmark), *words, "--json", str(goal)]) == 0
        (part,) = json.loads(goal.read_text())["parts"]
        scores.append({key: value for key, value in part.items() if key != "seconds"})
    np.testing.assert_equal(scores[0], scores[1])  # NaN equals NaN here
    assert scores[0]["dsc_surfaces"] > 0.8 and scores[0]["points"] == 348 + 7  # 90 % of 387, and 2 % of those


@pytest.mark.parametrize("text", ["5", "a-b", "1-2-3", ""])
def test_a_range_that_is_none_is_refused(benchmark, capsys, text):
    assert main([*COMMAND, "--data", str(benchmark), "--clouds", text]) == 2
    out, err = capsys.readouterr()
    assert out == "" and f"--clouds '{text}' is no range; expected two numbers such as 1-151." in err


def test_files_of_others_are_refused(tmp_path, capsys):
    foreign = tmp_path / "text.h5"
    foreign.write_text("nothing")
    for path in (foreign, tmp_path / "absent.h5"):
        assert main([*COMMAND, "--data", str(path)]) == 2
        assert str(path) in capsys.readouterr().err


@pytest.mark.parametrize("words", [("--noise", "-1"), ("--noise", "nan"), ("--every", "0")])
def test_numbers_without_a_meaning_are_refused(benchmark, capsys, words):
    assert main([*COMMAND, "--data", str(benchmark), *words]) == 2
    assert "0 or more" in capsys.readouterr().err


@pytest.mark.parametrize("words", [("--thin", "0"), ("--thin", "101"), ("--outliers", "-1"), ("--outliers", "nan")])
def test_shares_that_cannot_be_are_refused(benchmark, capsys, words):
    assert main([*COMMAND, "--data", str(benchmark), *words]) == 2
    assert "cannot be" in capsys.readouterr().err


def test_the_network_alone_answers_for_every_point(benchmark, tmp_path):
    goal = tmp_path / "alone.json"
    words = ["evaluate", "--protocol", "fit4cad", "--no-refine", "--data", str(benchmark), "--clouds", "1-1"]
    assert main([*words, "--json", str(goal)]) == 0
    (part,) = json.loads(goal.read_text())["parts"]
    assert part["unassigned"] == 0 and part["num_predicted"] >= 1 and 0 <= part["dsc_surfaces"] <= 1
    assert part["radius_error"] is None
