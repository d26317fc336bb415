"""Tables: aligned, with digits that suit the size of the scan."""

import numpy as np

from jprimfit.io.text_table import describe, length_formatter, primitives_table, text_table
from jprimfit.types import Cone, Cylinder, Plane, Sphere

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


def test_the_column_surface_appears_only_where_it_says_something():
    planes = (Plane(X, np.float64(2)),) * 2
    counts, rms = np.array([10, 0], np.int32), np.array([0.1, np.nan])
    alone = primitives_table(planes, counts, rms, np.array([0, 1], np.int32), extent=1.0)
    shared = primitives_table(planes, counts, rms, np.array([0, 0], np.int32), extent=1.0)
    assert "surface" not in alone and "surface" in shared and alone.splitlines()[-1].endswith("-")
    cut = primitives_table(planes, counts[::-1].copy(), rms, np.array([0, 1], np.int32), extent=1.0, max_rows=1)
    assert cut.splitlines()[2].startswith("1") and cut.splitlines()[3:] == ["and 1 smaller ones"]
    assert primitives_table((), counts[:0], rms[:0], counts[:0], extent=1.0) == "no primitives found"
