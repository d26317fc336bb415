"""Heads, shanks and recesses of standard parts have the sizes that they are asked for."""

import numpy as np
import pytest

from jprimfit.data import standard_blanks as blanks
from jprimfit.data.shapes import cylinder
from jprimfit.data.solids import difference, evaluate


def kinds(body):
    return [getattr(surface, "kind", None) for surface in body.surfaces]


def lowest_of_cut(tool, top):
    """The lowest point of what a tool removes from a cylinder whose upper end is at z = top."""
    body = evaluate(difference(cylinder(2.0, 4.0, (0, 0, top - 4)), tool))
    height = body.vertices[:, 2]
    return float(np.min(height[height > top - 3.9]))


def test_sizes_in_units_keep_their_ratios_and_the_way_back():
    unit, sizes = blanks.in_units(40, 40, 10, 2.5)
    assert sizes == pytest.approx([blanks.SPAN, blanks.SPAN / 4, blanks.SPAN / 16])
    assert np.array(sizes) * unit == pytest.approx([40, 10, 2.5])


@pytest.mark.parametrize(("sides", "both", "cones"), [(6, False, 1), (6, True, 2), (4, True, 2)])
def test_a_wrench_prism_has_its_width_across_flats_and_its_chamfers(sides, both, cones):
    body = evaluate(blanks.wrench_prism(sides, 3.0, 2.0, both=both))
    low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
    assert (high - low)[2] == pytest.approx(2) and low[2] == pytest.approx(0)
    flats = [surface for surface in body.surfaces if surface.kind == "plane" and abs(surface.normal[2]) < 0.5]
    assert len(flats) == sides and [abs(flat.offset) for flat in flats] == pytest.approx([1.5] * sides)
    assert kinds(body).count("cone") == cones and kinds(body).count("plane") == sides + 2
    top = body.vertices[np.isclose(body.vertices[:, 2], 2)]
    assert np.hypot(*top[:, :2].T).max() == pytest.approx(0.95 * 1.5)


@pytest.mark.parametrize(
    ("tool", "depth"),
    [
        (blanks.slot(0.3, 0.5, 1.0, 4.0), 0.5),
        (blanks.cross(1.5, 0.6, 1.0), 0.6),
        (blanks.hexagon(1.2, 0.7, 1.0, drilled=False), 0.7),
        (blanks.hexagon(1.2, 0.7, 1.0, drilled=True), 0.7 + 0.46 * 1.2 / np.tan(np.deg2rad(60))),
    ],
)
def test_recesses_are_as_deep_as_asked(tool, depth):
    assert lowest_of_cut(tool, 1.0) == pytest.approx(1.0 - depth, abs=1e-6)


def test_a_shank_is_chamfered_and_reaches_from_its_end_into_the_head():
    widths = set()
    for seed in range(8):
        body = evaluate(blanks.shank(np.random.default_rng(seed), 2.0, 9.0, into=0.5))
        assert body.vertices[:, 2].min() == pytest.approx(-9) and body.vertices[:, 2].max() == pytest.approx(0.5)
        radii = sorted(float(surface.radius) for surface in body.surfaces if surface.kind == "cylinder")
        assert kinds(body).count("cone") == 1 and radii[-1] == 1.0
        widths.add(len(radii))
    assert widths == {1, 2}  # with and without a thinner thread


def test_a_tube_is_bored_and_chamfered_outside():
    body = evaluate(blanks.tube(0.5, 1.0, 2.0, 1.0, 0.1))
    assert sorted(kinds(body)) == ["cone", "cone", "cylinder", "cylinder", "plane", "plane"]
    assert body.vertices[:, 2].min() == pytest.approx(1) and body.vertices[:, 2].max() == pytest.approx(3)
