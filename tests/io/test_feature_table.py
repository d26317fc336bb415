"""features.csv: what a spreadsheet reads is what was measured; nothing is said where nothing is known."""

import csv

import numpy as np

from jprimfit.io.feature_table import COLUMNS, write_features
from jprimfit.types import Cone, Feature, Plane, Sphere

Z, ZERO = np.array([0.0, 0, 1]), np.zeros(3)


def _read(path):
    data = path.read_bytes()
    assert data.count(b"\r\n") == data.count(b"\n")
    return list(csv.DictReader(data.decode("utf-8").splitlines()))


def test_every_kind_has_its_columns_and_all_digits(tmp_path):
    errors = {"direction": np.radians(0.25), "position": 0.125, "half_angle": np.radians(0.5)}
    cone = Feature(
        num_points=7, rms=0.1, largest_deviation=-1 / 3, position=np.array([1.0, 2, 3]), area=4.0, length=5.0,
        end_radii=(1.0, 2.0), arc=np.pi, is_hole=True, standard_errors=errors, warning='only 7 points; "thin", too',
    )  # fmt: skip
    ball = Feature(9, 0.1, 0.2, ZERO, 4.0, solid_angle=np.pi, standard_errors={"radius": np.inf, "position": 0.5})
    plate = Feature(9, np.nan, np.nan, ZERO, 4.0, length=3.0, width=2.0, standard_errors={"offset": 0.5})
    primitives = (Cone(Z, ZERO, np.float64(np.pi / 6)), Sphere(ZERO, np.float64(2)), Plane(Z, np.float64(0)))
    names = ("cone_0", "sphere_1", "plane_2")
    write_features(tmp_path / "features.csv", names, primitives, (cone, ball, plate), np.array([0, 1, 5], np.int32))
    first, second, third = _read(tmp_path / "features.csv")
    assert tuple(first) == COLUMNS and len({len(row) for row in (first, second, third)}) == 1
    assert first["side"] == "hole" and first["warning"] == 'only 7 points; "thin", too'
    assert float(first["largest deviation [unit]"]) == -1 / 3 and float(first["position y [unit]"]) == 2.0
    np.testing.assert_allclose([float(first[k]) for k in ("arc [deg]", "half-angle [deg]")], [180, 30])
    np.testing.assert_allclose(float(first["direction +- [deg]"]), 0.25)
    assert (first["start radius [unit]"], first["end radius [unit]"], first["diameter [unit]"]) == ("1.0", "2.0", "")
    assert (second["diameter [unit]"], second["diameter +- [unit]"], second["side"]) == ("4.0", "", "")
    np.testing.assert_allclose(float(second["sphere seen [%]"]), 25.0)
    assert (third["width [unit]"], third["rms [unit]"], third["surface"]) == ("2.0", "", "5")
    assert (third["position +- [unit]"], third["direction z"], second["direction z"]) == ("0.5", "1.0", "")


def test_no_primitives_leave_the_header(tmp_path):
    write_features(tmp_path / "features.csv", (), (), (), np.zeros(0, np.int32))
    assert (tmp_path / "features.csv").read_text(encoding="utf-8").strip().split(",") == list(COLUMNS)
