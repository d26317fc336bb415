"""Tables: aligned, with digits that suit the size of the scan."""

import numpy as np

from jprimfit.io.text_table import describe, length_formatter, primitives_table, text_table
from jprimfit.types import Cone, Cylinder, Feature, Plane, Sphere

X, ZERO = np.array([1.0, 0, 0]), np.zeros(3)


def test_numbers_stand_right_and_words_left():
    assert text_table(["name", "n"], [["a", "5"], ["long one", "1,000"]]).splitlines() == [
        "name          n",
        "--------  -----",
        "a             5",
        "long one  1,000",
    ]


def test_lengths_follow_the_size_of_the_scan():
    assert length_formatter(100.0)(12.34567) == "12.346"
    assert length_formatter(0.2)(0.0386123) == "0.038612"
    assert length_formatter(3e6)(1234567.8) == "1234568"
    assert length_formatter(1e-6)(5.5e-7) == "5.50000e-07"
    assert length_formatter(0.0)(3.25) == "3.25"
    assert length_formatter(100.0)(-0.0001) == "0.000" and length_formatter(100.0)(-0.001) == "-0.001"


def test_every_kind_is_described_with_angles_in_degrees():
    length = length_formatter(10.0)
    tilted = np.array([1.0, -1e-5, -0.0])
    assert describe(Plane(tilted, np.float64(2)), length) == ("", "(1.0000, 0.0000, 0.0000)", "offset 2.0000")
    assert describe(Sphere(ZERO, np.float64(2)), length)[0] == "r = 2.0000, d = 4.0000"
    assert describe(Cylinder(X, ZERO, np.float64(2)), length)[2] == "center (0.0000, 0.0000, 0.0000)"
    assert describe(Cone(X, ZERO, np.float64(np.pi / 6)), length)[0] == "half-angle 30.000 deg"


def _feature(num_points, **fields):
    return Feature(num_points, 0.1, 0.2, ZERO, 1.0, **fields)


def test_a_row_tells_size_extent_position_and_uncertainty():
    tube = _feature(1200, length=5.0, is_hole=True, standard_errors={"radius": 0.01})
    plate = _feature(9, length=8.0, width=3.0)
    primitives = (Cylinder(X, ZERO, np.float64(2)), Plane(X, np.float64(2)))
    lines = primitives_table(primitives, (tube, plate), np.array([0, 1], np.int32), extent=10.0).splitlines()
    assert "cylinder hole   1,200  d 4.0000 +-0.0200" in lines[2] and "5.000" in lines[2] and "*" not in lines[2]
    assert "8.000 x 3.000  1.000 0.000 0.000  0.000 0.000 0.000" in lines[3] and len(lines) == 4
    assert len(lines[2]) < 110
    ball, cone = Sphere(ZERO, np.float64(2)), Cone(X, ZERO, np.float64(np.pi / 6))
    unknown, known = {"radius": 9.0}, {"half_angle": np.radians(0.5)}
    features = (_feature(5, is_hole=False, standard_errors=unknown), _feature(5, standard_errors=known))
    lines = primitives_table((ball, cone), features, np.array([0, 1], np.int32), extent=10.0).splitlines()
    assert "sphere boss" in lines[2] and "d 4.0000 +-?" in lines[2] and "30.00 +-0.50 deg" in lines[3]


def test_what_speaks_against_a_row_stands_below():
    planes = (Plane(X, np.float64(2)),) * 2
    features = (_feature(10), _feature(3, warning="only 3 points")._replace(rms=np.nan))
    shared = primitives_table(planes, features, np.array([0, 0], np.int32), extent=1.0).splitlines()
    assert shared[3].startswith("1*") and shared[3].endswith(" -") and not shared[2].startswith("0*")
    assert shared[-1] == "* 1 plane: on the surface of #0; only 3 points"
    cut = primitives_table(planes, features[::-1], np.array([0, 1], np.int32), extent=1.0, max_rows=1)
    assert cut.splitlines()[2].startswith("1 ") and cut.splitlines()[3:] == ["and 1 smaller ones"]
    assert primitives_table((), (), np.zeros(0, np.int32), extent=1.0) == "no primitives found"
