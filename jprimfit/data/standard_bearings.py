"""Standard rolling bearings, and the blocks that hold them.

Bores, outsides and widths are rows of bd_warehouse's tables single_row_deep_groove_ball_bearing,
single_row_cylindrical_roller_bearing and single_row_tapered_roller_bearing (standard_blanks names the version), as are
the inner diameters of the rings of the straight ones. Rolling elements, races of tapered bearings and blocks are by
proportion. The grooves of ball races, which are tori, are left out, so that balls sink a little into their rings; so do
rollers, and a bearing is one piece.
"""

from collections.abc import Sequence

import numpy as np

from jprimfit.data.families_turned import chance, turned
from jprimfit.data.shapes import Real, cylinder, drill, extrude, place, polygon, ring, rotate, sphere, stadium
from jprimfit.data.shapes import cone as frustum
from jprimfit.data.solids import Solid, difference, union
from jprimfit.data.standard_blanks import Measured, in_units, pick, tube

# Bore, outside, width, outside of the inner ring, inside of the outer ring.
_BALL_BEARINGS = (
    *(
        (4, 16, 5, 8.4, 12),
        (6, 15, 5, 8.2, 11.7),
        (7, 17, 5, 10.4, 13.6),
        (7, 22, 7, 12.1, 17.6),
        (8, 16, 4, 10.5, 13.5),
    ),
    *((8, 22, 7, 12.1, 17.6), (8, 24, 8, 14.4, 19.8), (9, 24, 7, 14.4, 19.8), (9, 26, 8, 14.8, 21.2)),
    *((10, 19, 5, 12.7, 16.3), (10, 26, 8, 14.8, 21.2), (10, 30, 9, 17, 23.2)),
)
_ROLLER_BEARINGS = (
    *((15, 35, 11, 21.9, 27.9), (17, 40, 12, 25, 32.4), (17, 47, 14, 27.7, 37), (20, 47, 14, 29.7, 38.8)),
    *((20, 52, 15, 31.2, 42.4), (20, 52, 21, 31.2, 42.4), (25, 52, 15, 34.7, 43.8)),
)
# Bore, outside, whole width, width of the inner and of the outer ring.
_TAPERED_BEARINGS = (
    *((15, 42, 14.25, 13, 11), (17, 40, 13.25, 12, 11), (17, 47, 15.25, 14, 12), (20, 47, 15.25, 14, 12)),
    *((20, 52, 16.25, 15, 13), (22, 44, 15, 15, 11.5), (25, 52, 16.25, 15, 13), (25, 62, 18.25, 17, 15)),
    *((30, 62, 17.25, 16, 14), (30, 72, 20.75, 19, 16), (32, 58, 17, 17, 13)),
)


def _rings(draw: np.random.Generator, row: Sequence[Real]) -> tuple[Solid, float, list[float]]:
    """The two rings of a straight bearing, the unit, and its sizes with radii instead of diameters."""
    unit, (bore, outside, width, inner, outer) = in_units(row[1], *row)
    bevel = draw.uniform(0.04, 0.09) * width
    solid = union(_ring(bore / 2, inner / 2, width, bevel, 0), _ring(outer / 2, outside / 2, width, bevel, 1))
    return solid, unit, [bore / 2, outside / 2, width, inner / 2, outer / 2]


def _ring(inner: Real, outer: Real, width: Real, bevel: Real, side: int) -> Solid:
    """A ring about z = 0 with chamfers on its inner (side 0) or outer (side 1) edges."""
    corners = [(inner, -width / 2), (outer, -width / 2), (outer, width / 2), (inner, width / 2)]
    return turned(corners, [-bevel * (1 - side), -bevel * side, -bevel * side, -bevel * (1 - side)])


def ball_bearing(draw: np.random.Generator) -> Measured:
    """A deep groove ball bearing: open, its balls between the rings, or closed by shields."""
    solid, unit, (_, _, width, inner, outer) = _rings(draw, pick(draw, _BALL_BEARINGS))
    middle = (inner + outer) / 2
    if chance(draw, 0.3):
        low = width * draw.uniform(0.55, 0.85)
        return Measured(union(solid, tube(inner * 0.97, outer * 1.02, low, -low / 2)), unit)
    ball = min((outer - inner) / 2 * draw.uniform(1.25, 1.5), 0.42 * width)
    ball = max(ball, (outer - inner) / 2 * 1.08)
    most = int(2 * np.pi * middle / (2.15 * ball))
    count = int(draw.integers(min(6, most), most + 1))
    return Measured(union(solid, *ring(sphere(ball, (middle, 0, 0)), count, draw.uniform(0, 1))), unit)


def roller_bearing(draw: np.random.Generator) -> Measured:
    """A cylindrical roller bearing: rollers between two rings, one of them with ribs."""
    solid, unit, (_, outside, width, inner, outer) = _rings(draw, pick(draw, _ROLLER_BEARINGS))
    middle, size = (inner + outer) / 2, (outer - inner) / 2 * draw.uniform(1.2, 1.45)
    high = width * draw.uniform(0.7, 0.85)
    most = min(int(2 * np.pi * middle / (2.2 * size)), 12)
    count = int(draw.integers(max(7, most - 4), most + 1))
    rollers = ring(cylinder(size, high, (middle, 0, -high / 2)), count, draw.uniform(0, 1))
    rib = (width - high) / 2 * 0.8
    ribs = [
        tube((outside + outer) / 2 - 0.9 * size, (outside + outer) / 2, rib, z) for z in (-width / 2, width / 2 - rib)
    ]
    return Measured(union(solid, *ribs[: int(draw.integers(0, 3))], *rollers), unit)


def tapered_roller_bearing(draw: np.random.Generator) -> Measured:
    """A tapered roller bearing: conical rings, a rib on the inner one, conical rollers that share their apex."""
    bore, outside, width, b, c = pick(draw, _TAPERED_BEARINGS)
    unit, (bore, outside, width, b, c) = in_units(outside, bore / 2, outside / 2, width, b, c)
    slope = np.tan(np.deg2rad(draw.uniform(11, 15)))
    rise = outside - bore
    middle, size = bore + 0.5 * rise, rise * draw.uniform(0.15, 0.18)
    low, high = middle - 0.8 * size, middle + 0.8 * size  # race radii half way up
    cone = [(bore, 0.0), (low - b / 2 * slope, 0.0), (low + 0.36 * b * slope, 0.86 * b)]
    cone += [(low + 0.3 * rise * 0.5, 0.86 * b), (low + 0.3 * rise * 0.5, b), (bore, b)]
    top = width - c
    cup = [
        (high + (top - b / 2) * slope, top),
        (outside, top),
        (outside, width),
        (high + (width - b / 2) * slope, width),
    ]
    bevel = 0.06 * width
    solid = union(turned(cone, [-bevel, 0, 0, 0, 0, -bevel]), turned(cup, [0, -bevel, -bevel, 0]))
    long, start = 0.72 * b, 0.12 * b
    angle = float(np.arctan(slope))
    taper = size * slope / middle
    roller = frustum(size - taper * long / 2, size + taper * long / 2, long, (0, 0, -long / 2))
    roller = place(rotate(roller, angle, "y"), (middle + (start + long / 2 - b / 2) * slope, 0, start + long / 2))
    most = int(2 * np.pi * middle / (2.2 * size))
    count = int(draw.integers(max(8, most - 4), most + 1))
    return Measured(union(solid, *ring(roller, count, draw.uniform(0, 1))), unit)


def bearing_block(draw: np.random.Generator) -> Measured:
    """A plummer block: a foot with two bolt slots, a round housing with a bore, a recess, an oil hole."""
    bore = draw.uniform(6, 30)
    reach, deep, high = bore * draw.uniform(2.6, 3.4), bore * draw.uniform(0.9, 1.6), bore * draw.uniform(1.6, 2.0)
    wall, foot = bore * draw.uniform(0.45, 0.7), bore * draw.uniform(0.35, 0.6)
    unit, (bore, reach, deep, high, wall, foot) = in_units(2 * reach, bore, reach, deep, high, wall, foot)
    outer = bore + wall
    section = [(-reach, 0.0), (reach, 0.0), (reach, foot), (outer, 1.2 * foot), (outer, high), (-outer, high)]
    base = polygon([*section, (-outer, 1.2 * foot), (-reach, foot)])
    solid = rotate(extrude(base, deep, -deep / 2), np.pi / 2, "x")
    solid = union(solid, cylinder(outer, deep * 1.1, (0, -0.55 * deep, high), "y"))
    x, size = (reach + outer) / 2, min(0.28 * (reach - outer), 0.2 * deep)
    slot = (
        extrude(stadium(size, size), 9 * foot, -foot) if chance(draw, 0.5) else cylinder(size, 9 * foot, (0, 0, -foot))
    )
    cuts: list[Solid] = [
        place(slot, (x, 0, 0)),
        place(slot, (-x, 0, 0)),
        cylinder(bore, 4 * deep, (0, -2 * deep, high), "y"),
    ]
    if chance(draw, 0.5):
        cuts.append(cylinder(bore + 0.5 * wall, deep, (0, 0.35 * deep, high), "y"))
    if chance(draw, 0.6):
        cuts.append(place(drill(0.2 * wall, 0.5 * outer, 0.0), (0, 0, high + outer)))
    return Measured(difference(solid, *cuts), unit)
