"""Which arrays can be a scan: what is dropped, what is refused, and that scale and position do not matter."""

import numpy as np
import pytest

from jprimfit.checks import usable_rows

POINTS = np.random.default_rng(0).normal(size=(30, 3))


@pytest.mark.parametrize(
    "convert", [np.asarray, list, lambda p: p.astype(np.float32), lambda p: (1000 * p).astype(np.int64)]
)
def test_numbers_of_any_type_become_float64(convert):
    usable = usable_rows(convert(POINTS))
    assert usable.points.dtype == np.float64 and usable.normals is None
    np.testing.assert_array_equal(usable.points, np.asarray(convert(POINTS), np.float64))
    np.testing.assert_array_equal(usable.rows, np.arange(30))


def test_jax_arrays_are_taken():
    import jax.numpy as jnp

    np.testing.assert_allclose(usable_rows(jnp.asarray(POINTS)).points, POINTS, atol=1e-6)


def test_rows_that_are_not_finite_are_dropped_and_the_map_kept():
    points = POINTS.copy()
    points[3, 1], points[7], points[11, 0], points[12, 2] = np.nan, np.inf, -np.inf, 1e200
    normals = np.tile([0.0, 0, 2], (30, 1))
    normals[7] = np.nan
    usable = usable_rows(points, normals)
    np.testing.assert_array_equal(usable.rows, np.delete(np.arange(30), [3, 7, 11, 12]))
    np.testing.assert_array_equal(usable.points, points[usable.rows])
    np.testing.assert_array_equal(usable.normals, np.tile([0, 0, 1], (26, 1)))


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf])
def test_normals_without_direction_are_all_left_out(bad):
    normals = np.tile([0.0, 0, 1], (30, 1))
    normals[5] = bad
    assert usable_rows(POINTS, normals).normals is None


@pytest.mark.parametrize("scale", [1e-90, 1e-6, 1.0, 1e90])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_scale_and_position_do_not_matter(scale, offset):
    cloud = (POINTS + offset) * scale
    assert len(usable_rows(cloud).points) == 30
    line = (offset + np.linspace(0, 1, 30)[:, None] * [1.0, 2.0, -1.0]) * scale
    with pytest.raises(ValueError, match="all 30 points lie on one line"):
        usable_rows(line)


def test_a_plane_and_four_corners_are_enough():
    assert len(usable_rows(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])).points) == 4
    assert len(usable_rows(POINTS * [1, 1e-4, 0]).points) == 30


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 3)), r"points is empty \(shape \(0, 3\)\)"),
        ([], "points is empty"),
        (POINTS[:1], "the scan has 1 point, 1 of them distinct: at least 4"),
        (np.ones((50, 3)), "50 points, 1 of them distinct"),
        (POINTS[[0, 1, 2, 0, 1, 2]], "6 points, 3 of them distinct"),
        (np.full((9, 3), np.nan), "0 points, 0 of them distinct after dropping 9 rows"),
        (POINTS[:, :2], r"points has shape \(30, 2\), but \(n, 3\) is expected"),
        (POINTS[0], r"points has shape \(3,\)"),
        (POINTS[None], r"points has shape \(1, 30, 3\)"),
        ([[1, 2, 3], [4, 5]], "points is no array"),
        ([["a", "b", "c"]], "type <U1"),
        (POINTS.astype(complex), "type complex128"),
        (POINTS > 0, "type bool"),
        (None, "type object"),
    ],
)
def test_what_can_be_no_scan_is_one_sentence(points, message):
    with pytest.raises(ValueError, match=message) as caught:
        usable_rows(points)
    assert str(caught.value).endswith(".") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("normals", "message"),
    [
        (POINTS[:5], "normals has 5 rows and points 30"),
        (POINTS[:, :2], r"normals has shape \(30, 2\)"),
        ("up", "normals holds"),
    ],
)
def test_normals_must_fit_the_points(normals, message):
    with pytest.raises(ValueError, match=message):
        usable_rows(POINTS, normals)
