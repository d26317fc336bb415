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
