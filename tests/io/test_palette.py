"""Colours: the same for the same label whatever the number, and far apart for the first ones."""

import numpy as np

from jprimfit.io import palette


def test_a_color_does_not_depend_on_how_many_there_are():
    np.testing.assert_array_equal(palette.colors(5), palette.colors(50)[:5])
    assert palette.colors(0).shape == (0, 3)


def test_the_first_colors_are_distinct_from_each_other_and_from_grey():
    colors = np.concatenate([palette.colors(21), [palette.GREY]]).astype(float)
    apart = np.linalg.norm(colors[:, None] - colors[None, :], axis=2) + 1e3 * np.eye(22)
    assert apart.min() > 45
    assert np.diag(apart, 1)[:20].min() > 110


def test_labels_take_their_colors_and_none_is_grey():
    found = palette.colors_of_labels(np.array([2, -1, 0, 2], np.int32))
    np.testing.assert_array_equal(found[[0, 2, 3]], palette.colors(3)[[2, 0, 2]])
    assert tuple(found[1]) == palette.GREY
    assert palette.colors_of_labels(np.array([], np.int32)).shape == (0, 3)


def test_deviations_run_from_blue_over_white_to_red():
    found = palette.colors_of_deviations(np.array([-9.0, -1, 0, 0.5, 1, 9, np.nan, np.inf]), scale=1.0).astype(int)
    np.testing.assert_array_equal(found[[0, 5]], found[[1, 4]])
    assert found[2].tolist() == [255, 255, 255] and found[6].tolist() == found[7].tolist() == list(palette.GREY)
    assert found[1, 2] > found[1, 0] + 100 and found[4, 0] > found[4, 2] + 100
    assert found[4, 1] < found[3, 1] < 255 and found[3, 0] > 230
    assert palette.colors_of_deviations(np.zeros(2), scale=0.0).tolist() == [[255, 255, 255]] * 2
