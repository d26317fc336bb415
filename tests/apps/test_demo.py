"""`jprimfit demo`: the truth is read whole, and stands beside the primitive that is nearest to it."""

import numpy as np

from jprimfit.apps import demo
from jprimfit.apps.main import main
from jprimfit.io.clouds import read_cloud
from jprimfit.scene import Scene
from jprimfit.types import Cone, Cylinder, Plane, Sphere

X, Z = np.array([1.0, 0, 0]), np.array([0.0, 0, 1])
CENTER = np.array([500.0, 0, 0])


def test_the_bundled_truth_has_every_kind_and_fits_the_bundled_scan():
    truth = demo.read_truth(demo.ASSETS / "demo_truth.json")
    assert {p.kind for p in truth} == {"plane", "sphere", "cylinder", "cone"}
    points = read_cloud(demo.ASSETS / "demo.ply").points
    planes = [p for p in truth if p.kind == "plane"]
    assert all(np.sum(np.abs(points @ p.normal - p.offset) < 0.2) > 50 for p in planes)


def test_partners_are_the_nearest_of_their_kind():
    truth = [
        Plane(Z, np.float64(0)),
        Plane(Z, np.float64(10)),
        Sphere(CENTER, np.float64(5)),
        Cone(Z, CENTER, np.float64(0.5)),
    ]
    tilted = np.array([0.001, 0, 1]) / np.hypot(1, 0.001)
    found = [
        Cylinder(Z, CENTER, np.float64(5)),
        Plane(-Z, np.float64(-10.1)),
        Plane(tilted, np.float64(0.5)),
        Sphere(CENTER + 0.1 * X, np.float64(5.2)),
        Sphere(CENTER + 40, np.float64(5)),
    ]
    pairs = demo.match(truth, found, center=CENTER, extent=100.0)
    assert {i: j for i, (j, _) in pairs.items()} == {0: 2, 1: 1, 2: 3}
    np.testing.assert_allclose(pairs[1][1], [0, 0.1, 0], atol=1e-9)
    # At the centre of the scan the tilted plane is at 0.5 - 0.001 * 500 = 0: no shift is left.
    np.testing.assert_allclose(pairs[0][1], [0.001, 0, 0], atol=1e-5)
    np.testing.assert_allclose(pairs[2][1], [0, 0.1, 0.2], atol=1e-9)


def test_what_is_far_from_the_truth_is_not_its_answer():
    pairs = demo.match(
        [Cylinder(Z, CENTER, np.float64(13))], [Cylinder(Z, CENTER, np.float64(20))], center=CENTER, extent=100.0
    )
    assert pairs == {}


def test_truth_and_answer_stand_one_above_the_other():
    points = np.array([[0.0, 0, 0], [100, 50, 20]])
    none = np.zeros(2, np.int32)
    found = (Cone(Z, CENTER, np.float64(0.51)), *(Sphere(CENTER + i, np.float64(1)) for i in range(15)))
    scene = Scene(points, none, found, np.array([0, 0, *range(2, 16)], np.int32), points, np.zeros(2))
    lines = demo.truth_text([Cone(Z, CENTER, np.float64(0.5)), Plane(Z, np.float64(1))], scene).splitlines()
    assert lines[2].startswith("cone") and "half-angle 28.648 deg" in lines[2]
    assert "#0" in lines[3] and "half-angle 0.573 deg" in lines[3]
    assert "not found" in lines[5]
    assert lines[-1].startswith("found besides: sphere_1 (on the surface of #0), sphere_2, sphere_3") and lines[
        -1
    ].endswith("and 3 more")


def test_the_command_writes_the_files_and_prints_the_comparison(quick, tmp_path, capsys):
    assert main(["demo", "--out", str(tmp_path / "demo")]) == 0
    out = capsys.readouterr().out
    assert "truth" in out and "report.png" in out and (tmp_path / "demo" / "scene.json").exists()
    assert quick[0]["seed"] == 0
