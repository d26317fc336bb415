"""The contact sheet shows what it is given: colours of instances on the left, of kinds on the right."""

import numpy as np
import pytest
from PIL import Image

from jprimfit.io import palette, sheet

CUBE = np.array([(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([(a, b, c) for a, b, c, d in SIDES] + [(a, c, d) for a, b, c, d in SIDES])


def cell(labels, kinds):
    return sheet.Cell("a cube", CUBE, FACES, np.tile(np.array(labels), 2), np.array(kinds, np.int8))


def hues(picture):
    """The colours of a picture without their brightness, coarsely, and how often each occurs."""
    rows = picture.reshape(-1, 3).astype(float)
    rows = rows[np.ptp(rows, axis=1) > 30]
    unit, counts = np.unique((rows / rows.max(axis=1, keepdims=True) * 10).round(), axis=0, return_counts=True)
    return unit[counts > 40]


def nearest(color, found):
    color = np.asarray(color, float)
    return np.min(np.max(np.abs(found - color / color.max() * 10), axis=1))


def test_instances_are_left_and_kinds_right(tmp_path):
    sheet.write_sheet(tmp_path / "a.png", [cell(range(6), [0, 0, 0, 0, 0, 2])], kinds=("plane", "x", "cone"), title="t")
    with Image.open(tmp_path / "a.png") as file:
        page = np.array(file)
    assert page.shape == (sheet.TOP + 182, sheet.GAP + 312, 3)
    panels = page[sheet.TOP + sheet.CAPTION : -sheet.GAP, sheet.GAP : sheet.GAP + 300]
    left, right = hues(panels[:, :150]), hues(panels[:, 150:])
    instances, kinds = palette.colors(6), palette.colors(3)
    assert sum(nearest(color, left) <= 1 for color in instances) >= 3  # three sides of a cube are seen
    assert nearest(kinds[0], right) <= 1 and nearest(kinds[2], right) <= 1 and nearest(kinds[1], right) > 1


def test_background_is_grey_and_rows_are_filled(tmp_path):
    cells = [cell([-1] * 6, [])] * 7
    sheet.write_sheet(tmp_path / "a.png", cells, kinds=("plane",), title="t")
    with Image.open(tmp_path / "a.png") as file:
        page = np.array(file)
    assert page.shape == (sheet.TOP + 2 * 182, sheet.GAP + 5 * 312, 3)
    first = page[sheet.TOP + sheet.CAPTION : sheet.TOP + 170, sheet.GAP : sheet.GAP + 300]
    assert len(hues(first)) == 0 and np.mean(np.max(first, axis=2) < 200) > 0.1
    with pytest.raises(ValueError, match="b.png was not written: there is no part to show"):
        sheet.write_sheet(tmp_path / "b.png", [], kinds=("plane",), title="t")
    assert not (tmp_path / "b.png").exists()
