"""Standard machine elements: rings, collars, retaining rings, sprockets, keyed shafts.

Retaining rings and keyways are rows of bd_warehouse's tables din471, din472 and shaft_key (DIN 6885; standard_blanks
names the version); sprockets have the proportion of roller to pitch of that package. Lugs, collars, spacers, hubs and
shafts are by proportion.
"""

import numpy as np

from jprimfit.data.families_turned import chance, turned
from jprimfit.data.shapes import Real, box, cylinder, extrude, place, rectangle, ring, rotate, stadium
from jprimfit.data.solids import Solid, difference, union
from jprimfit.data.standard_blanks import Measured, in_units, pick, tube

# Shaft or bore, thickness, free diameter, lug, breadth of the ring opposite its gap, hole in the lug.
_DIN_471 = (
    *(
        (10, 1, 9.3, 3.3, 1.8, 1.5),
        (15, 1, 13.8, 3.6, 2.2, 1.7),
        (20, 1.2, 18.5, 4, 2.6, 2),
        (25, 1.2, 23.2, 4.4, 3, 2),
    ),
    *((30, 1.5, 27.9, 5, 3.5, 2), (40, 1.75, 36.5, 6, 4.4, 2.5), (60, 2, 55.8, 7.4, 5.8, 2.5)),
)
_DIN_472 = (
    *(
        (20, 1, 21.5, 4.2, 2.3, 2),
        (25, 1.2, 26.9, 4.5, 2.7, 2),
        (30, 1.2, 32.1, 4.8, 3, 2),
        (40, 1.75, 43.5, 5.8, 3.9, 2.5),
    ),
    *((50, 2, 54.2, 6.5, 4.6, 2.5), (80, 2.5, 85.5, 8.5, 7, 3)),
)
# Largest shaft, width and height of the key, depth of the hub's keyway: the shaft's is the rest.
_DIN_6885 = (
    *(
        (8, 2, 2, 1),
        (10, 3, 3, 1.4),
        (12, 4, 4, 1.8),
        (17, 5, 5, 2.3),
        (22, 6, 6, 2.8),
        (30, 8, 7, 3.3),
        (38, 10, 8, 3.3),
    ),
    *((44, 12, 8, 3.3), (50, 14, 9, 3.8)),
)
_ROLLER = 0.625  # diameter of a chain's roller in pitches


def spacer_ring(draw: np.random.Generator) -> Measured:
    """A ring or sleeve, thick or thin, chamfered or stepped."""
    outer = draw.uniform(8, 60)
    inner, high = outer * draw.uniform(0.55, 0.92), outer * draw.uniform(0.15, 1.6)
    unit, (outer, inner, high) = in_units(max(2 * outer, high), outer, inner, high)
    wall = outer - inner
    bevel = min(wall, high) * draw.uniform(0.1, 0.3) if chance(draw, 0.6) else 0.0
    solid: Solid = tube(inner, outer, high, 0.0, bevel)
    if chance(draw, 0.4):
        wide = inner + wall * draw.uniform(0.3, 0.6)
        solid = difference(solid, cylinder(wide, high, (0, 0, high * draw.uniform(0.4, 0.8))))
    return Measured(solid, unit)


def shaft_collar(draw: np.random.Generator) -> Measured:
    """A collar held on a shaft by a set screw or by a slit and a clamp screw."""
    bore = draw.uniform(4, 25)
    outer, high = bore * draw.uniform(1.7, 2.1), bore * draw.uniform(0.7, 1.2)
    unit, (bore, outer, high) = in_units(2 * outer, bore, outer, high)
    solid: Solid = tube(bore, outer, high, 0.0, high * draw.uniform(0.04, 0.1))
    size, middle = min(0.2 * high, 0.3 * (outer - bore)), (bore + outer) / 2
    cuts: list[Solid] = [cylinder(size, 2 * outer, (0, 0, high / 2), "x")]
    if chance(draw, 0.5):
        gap = 0.25 * bore
        cuts = [
            box((2 * outer, gap, 3 * high), (outer, 0, 0)),
            cylinder(size, 4 * outer, (middle, -2 * outer, high / 2), "y"),
        ]
        if chance(draw, 0.7):
            cuts.append(cylinder(1.6 * size, 2 * outer, (middle, 0.35 * outer, high / 2), "y"))
    return Measured(difference(solid, *cuts), unit)


def retaining_ring(draw: np.random.Generator) -> Measured:
    """An open ring with two drilled lugs, for a shaft (DIN 471, lugs outside) or a bore (DIN 472, lugs inside)."""
    outside = chance(draw, 0.5)
    _, s, d3, a, b, hole = pick(draw, _DIN_471 if outside else _DIN_472)
    s = s * draw.uniform(0.9, 1.1)
    unit, (s, d3, a, b, hole) = in_units(d3 + 2 * b * outside, s, d3, a, b, hole)
    edge = d3 / 2
    # Broad opposite the gap, narrow beside it: the free edge is a circle about another centre.
    if outside:
        plate = difference(cylinder(edge + 0.8 * b, s, (-0.2 * b, 0, 0)), cylinder(edge, 3 * s, (0, 0, -s)))
        middle = edge + a / 2
    else:
        plate = difference(cylinder(edge, s), cylinder(edge - 0.8 * b, 3 * s, (0.2 * b, 0, -s)))
        middle = float(np.sqrt(edge**2 - (0.45 * a) ** 2)) - a / 2
    gap = a * draw.uniform(0.2, 0.5)
    turn = (0.45 * a + gap) / middle
    lug = difference(
        place(extrude(rectangle(a, 0.9 * a, 0.25 * a), s), (middle, 0, 0)), cylinder(hole / 2, 3 * s, (middle, 0, -s))
    )
    far = 3 * edge
    cuts = [box((far, 2 * gap, 5 * s), (far / 2, 0, 0))]
    cuts += [rotate(cylinder(hole / 2, 3 * s, (middle, 0, -s)), side * turn) for side in (1, -1)]
    return Measured(difference(union(plate, rotate(lug, turn), rotate(lug, -turn)), *cuts), unit)


def _keyway(shaft: Real, unit: Real) -> tuple[float, float, float]:
    """Width of the key for a shaft of this diameter, depth of its keyway in the shaft and in the hub."""
    _, b, h, t2 = next((row for row in _DIN_6885 if row[0] >= shaft * unit), _DIN_6885[-1])
    return b / unit, (h - t2) / unit, t2 / unit


def roller_sprocket(draw: np.random.Generator) -> Measured:
    """A chain wheel: seats for rollers on the pitch circle, teeth chamfered or not, a hub, a bore with a keyway."""
    count, pitch = int(draw.integers(8, 15)), draw.uniform(8, 25)
    tip = pitch * (0.5 / np.sin(np.pi / count) + 0.22)
    shaft = draw.uniform(0.3, 0.45) * tip
    unit, (pitch, tip, shaft) = in_units(2 * tip, pitch, tip, shaft)
    middle, thick = pitch / 2 / np.sin(np.pi / count), pitch * draw.uniform(0.4, 0.8)
    seat = _ROLLER / 2 * pitch * 1.08
    plate: Solid = cylinder(tip, thick)
    if chance(draw, 0.6):
        fall, width = 0.2 * thick, tip - middle
        corners = [(0.0, 0.0), (tip - width, 0.0), (tip, fall), (tip, thick - fall), (tip - width, thick), (0.0, thick)]
        plate = turned(corners)
    plate = difference(plate, *ring(cylinder(seat, 3 * thick, (middle, 0, -thick)), count))
    foot = middle - seat
    hub = min(shaft * draw.uniform(0.8, 1.0), 0.85 * foot)
    if chance(draw, 0.7):
        plate = union(plate, tube(0.0, hub, thick * draw.uniform(1.6, 3.0), 0.0, 0.05 * hub))
    cuts: list[Solid] = [cylinder(shaft / 2, 9 * thick, (0, 0, -thick))]
    if chance(draw, 0.6):
        wide, _, deep = _keyway(shaft, unit)
        cuts.append(box((shaft / 2 + deep, wide, 9 * thick), (shaft / 4 + deep / 2, 0, 0)))
    if foot - hub > 0.5 * hub and chance(draw, 0.5):
        spot, size = (foot + hub) / 2, 0.3 * (foot - hub)
        cuts += ring(cylinder(size, 3 * thick, (spot, 0, -thick)), int(draw.integers(3, 7)), 0.3)
    return Measured(difference(plate, *cuts), unit)


def keyed_shaft(draw: np.random.Generator) -> Measured:
    """A shaft of three to five steps, thickest in the middle, with keyways and grooves for retaining rings."""
    count, d = int(draw.integers(3, 6)), draw.uniform(8, 40)
    thickest = int(draw.integers(1, count - 1))
    ratio = draw.uniform(0.75, 0.92)
    diameters = [d * ratio ** abs(j - thickest) for j in range(count)]
    lengths = d * draw.uniform(0.5, 1.8, count)
    unit, (d, *sizes) = in_units(float(np.sum(lengths)), d, *diameters, *lengths)
    radii, lengths, ends = np.array(sizes[:count]) / 2, np.array(sizes[count:]), np.cumsum(sizes[count:])
    points, rounding = [(0.0, 0.0), (radii[0], 0.0)], [0.0, -0.12 * radii[0]]
    for j in range(1, count):
        points += [(radii[j - 1], ends[j - 1]), (radii[j], ends[j - 1])]
        rounding += [0.0, 0.0]
    points += [(radii[-1], ends[-1]), (0.0, ends[-1])]
    solid, cuts = turned(points, [*rounding, -0.12 * radii[-1], 0.0]), []
    for j in range(count):
        middle, radius, long = float(ends[j] - lengths[j] / 2), float(radii[j]), float(lengths[j])
        wide, deep, _ = _keyway(2 * radius, unit)
        if long > 2.2 * wide and chance(draw, 0.45):
            reach = min(0.8 * long, 2.5 * radius) - wide
            seat = rotate(extrude(stadium(reach, wide / 2), radius, radius - deep), np.pi / 2, "y")
            cuts.append(place(seat, (0, 0, middle)))
        elif j in (0, count - 1) and long > radius and chance(draw, 0.5):
            low, groove = (0.2 if j == 0 else -0.28) * long, 0.08 * long
            start = float(ends[j] - lengths[j]) + low if j == 0 else float(ends[j]) + low
            cuts.append(tube(0.88 * radius, 2 * radius, groove, start))
    return Measured(difference(solid, *cuts), unit)
