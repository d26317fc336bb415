"""Standard pipe flanges with their bolt circles, and gaskets.

Dimensions are rows of bd_warehouse's tables flange_data_class and drilling_class for classes 150 and 300 of ASME B16.5
(standard_blanks names the version), in millimetres, its bolt holes converted from inches. Raised faces are 2 mm high as
told there, their diameter, the faces of gaskets and all chamfers are by proportion; fillets are left out. The bore of a
part is drawn within 2 % of its row's, so that no two are alike.
"""

from typing import NamedTuple

import numpy as np

from jprimfit.data.families_turned import chance, turned
from jprimfit.data.shapes import Real, cylinder, ring
from jprimfit.data.solids import Solid, difference, union
from jprimfit.data.standard_blanks import Measured, in_units, pick, tube

# Outside diameter, thickness, thickness of a lapped flange, diameter of the hub at the plate and at its weld, length of
# the slip-on, the lapped and the weld-neck hub, bores of the three, bolt circle, bolt hole, number of holes.
_B16_5 = (
    (90, 9.6, 11.2, 30, 21.3, 14, 16, 46, 22.2, 22.9, 15.8, 60.3, 15.9, 4),
    (100, 11.2, 12.7, 38, 26.7, 14, 16, 51, 27.7, 28.2, 20.9, 69.9, 15.9, 4),
    (110, 12.7, 14.3, 49, 33.4, 16, 17, 54, 34.5, 34.9, 26.6, 79.4, 15.9, 4),
    (125, 15.9, 17.5, 65, 48.3, 21, 22, 60, 49.5, 50.0, 40.9, 98.4, 15.9, 4),
    (150, 17.5, 19.1, 78, 60.3, 24, 25, 62, 61.9, 62.5, 52.5, 120.7, 19.05, 4),
    (190, 22.3, 23.9, 108, 88.9, 29, 30, 68, 90.7, 91.4, 77.9, 152.4, 19.05, 4),
    (230, 22.3, 23.9, 135, 114.3, 32, 33, 75, 116.1, 116.8, 102.3, 190.5, 19.05, 8),
    (280, 23.9, 25.4, 192, 168.3, 38, 40, 87, 170.7, 171.4, 154.1, 241.3, 22.2, 8),
    (345, 27.0, 28.6, 246, 219.1, 43, 44, 100, 221.5, 222.2, 202.7, 298.5, 22.2, 8),
    (405, 28.6, 30.2, 305, 273.0, 48, 49, 100, 276.2, 277.4, 254.6, 362.0, 25.4, 12),
    (95, 12.7, 14.3, 38, 21.3, 21, 22, 51, 22.2, 22.9, 15.8, 66.7, 15.9, 4),
    (125, 15.9, 17.5, 54, 33.4, 25, 27, 60, 34.5, 34.9, 26.6, 88.9, 19.05, 4),
    (155, 19.1, 20.7, 70, 48.3, 29, 30, 67, 49.5, 50.0, 40.9, 114.3, 22.2, 4),
    (165, 20.7, 22.3, 84, 60.3, 32, 33, 68, 61.9, 62.5, 52.5, 127.0, 19.05, 8),
    (210, 27.0, 28.6, 117, 88.9, 41, 43, 78, 90.7, 91.4, 77.9, 168.3, 22.2, 8),
    (255, 30.2, 31.8, 146, 114.3, 46, 48, 84, 116.1, 116.8, 102.3, 200.0, 22.2, 8),
    (320, 35.0, 36.6, 206, 168.3, 51, 52, 97, 170.7, 171.4, 154.1, 269.9, 22.2, 12),
    (380, 39.7, 41.3, 260, 219.1, 60, 62, 110, 221.5, 222.2, 202.7, 330.2, 25.4, 12),
)
_FACE = 2.0  # mm, height of a raised face


class _Row(NamedTuple):
    """A row of the table in units of its solid, diameters halved."""

    unit: float
    rim: float
    thick: float
    thick_lapped: float
    foot: float  # of the hub
    weld: float
    slip_on: float  # lengths through the hub
    lapped: float
    weld_neck: float
    bores: list[float]  # slip-on, lapped, weld-neck
    circle: float
    hole: float
    count: int
    face: float


def _row(draw: np.random.Generator) -> _Row:
    *sizes, count = pick(draw, _B16_5)
    unit, sizes = in_units(sizes[0], *sizes, _FACE)
    rim, thick, thick_lapped, foot, weld, slip_on, lapped, weld_neck = sizes[:8]
    circle, hole, face = sizes[11:]
    return _Row(
        unit=unit,
        rim=rim / 2,
        thick=thick,
        thick_lapped=thick_lapped,
        foot=foot / 2,
        weld=weld / 2,
        slip_on=slip_on,
        lapped=lapped,
        weld_neck=weld_neck,
        bores=(np.array(sizes[8:11]) / 2 * draw.uniform(0.98, 1.0, 3)).tolist(),
        circle=circle / 2,
        hole=hole / 2,
        count=count,
        face=face,
    )


def _raised(row: _Row) -> float:
    """The radius of the raised face."""
    return 0.94 * (row.circle - row.hole)


def _holes(row: _Row) -> list[Solid]:
    """The bolt holes, straddling the centre lines."""
    hole = cylinder(row.hole, 4 * row.weld_neck, (row.circle, 0, -2 * row.weld_neck))
    return ring(hole, row.count, np.pi / row.count)


def _finished(draw: np.random.Generator, row: _Row, solid: Solid, bore: Real) -> Measured:
    """With a raised face on z = 0 or without, bored where the bore is above 0, drilled."""
    cuts = _holes(row)
    if chance(draw, 0.5):
        solid = union(solid, cylinder(_raised(row), row.face + row.thick / 2, (0, 0, -row.face)))
    if bore:
        cuts.append(cylinder(bore, 4 * row.weld_neck, (0, 0, -2 * row.weld_neck)))
    return Measured(difference(solid, *cuts), row.unit)


def blind_flange(draw: np.random.Generator) -> Measured:
    """A disc without a bore."""
    row = _row(draw)
    thick = row.thick * draw.uniform(0.98, 1.02)
    bevel = row.thick * draw.uniform(0.05, 0.12) if chance(draw, 0.4) else 0.0
    return _finished(draw, row, tube(0.0, row.rim, thick, 0.0, bevel), 0.0)


def slip_on_flange(draw: np.random.Generator) -> Measured:
    """A flange with a low hub that the pipe slips through."""
    row = _row(draw)
    top = row.foot - (row.slip_on - row.thick) * draw.uniform(0.1, 0.4)
    points = [(0.0, 0.0), (row.rim, 0.0), (row.rim, row.thick), (row.foot, row.thick), (top, row.slip_on)]
    return _finished(draw, row, turned([*points, (0.0, row.slip_on)]), row.bores[0])


def weld_neck_flange(draw: np.random.Generator) -> Measured:
    """A flange whose hub tapers to the pipe it is welded to."""
    row = _row(draw)
    straight = (row.weld_neck - row.thick) * draw.uniform(0.15, 0.35)
    points = [(0.0, 0.0), (row.rim, 0.0), (row.rim, row.thick), (row.foot, row.thick)]
    end = row.weld_neck
    solid = turned([*points, (row.weld, end - straight), (row.weld, end), (0.0, end)])
    return _finished(draw, row, solid, row.bores[2])


def lapped_flange(draw: np.random.Generator) -> Measured:
    """A loose flange with a straight hub, its bore chamfered where the lap of a stub end lies."""
    row = _row(draw)
    bore, bevel = row.bores[1], (row.circle - row.hole - row.bores[1]) * draw.uniform(0.1, 0.25)
    points = [(bore + bevel, 0.0), (row.rim, 0.0), (row.rim, row.thick_lapped), (row.foot, row.thick_lapped)]
    solid = turned([*points, (row.foot, row.lapped), (bore, row.lapped), (bore, bevel)])
    return Measured(difference(solid, *_holes(row)), row.unit)


def full_face_gasket(draw: np.random.Generator) -> Measured:
    """A flat gasket as wide as the flange, with its bolt holes."""
    row = _row(draw)
    thick = row.rim * draw.uniform(0.02, 0.06)
    bore = row.bores[0] * draw.uniform(1.0, 1.1)
    return Measured(difference(tube(bore, row.rim, thick), *_holes(row)), row.unit)


def ring_gasket(draw: np.random.Generator) -> Measured:
    """A gasket within the bolt circle: flat, or of an octagonal section for a ring joint (by proportion)."""
    row = _row(draw)
    bore, outer = row.bores[0] * draw.uniform(1.0, 1.15), row.circle - row.hole
    unit, (bore, outer) = row.unit * outer / row.rim, [size * row.rim / outer for size in (bore, outer)]
    if chance(draw, 0.5):
        return Measured(tube(bore, outer, outer * draw.uniform(0.02, 0.08)), unit)
    width, middle = outer * draw.uniform(0.1, 0.2), outer * 0.9
    high, flat, slope = width * draw.uniform(1.2, 1.6), width * 0.6, np.tan(np.deg2rad(23))
    fall = (width - flat) / 2 / slope
    side = [(flat / 2, -high / 2), (width / 2, fall - high / 2), (width / 2, high / 2 - fall), (flat / 2, high / 2)]
    return Measured(turned([(middle + a, b) for a, b in side] + [(middle - a, -b) for a, b in side]), unit)
