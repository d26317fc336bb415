"""Standard pins and keys: dowel, taper, grooved, spring and clevis pins, drive studs, parallel keys.

The section of a parallel key is a row of bd_warehouse's table shaft_key (DIN 6885; standard_blanks names the version).
All pins are by proportion, the taper pin with the slope of 1 in 50 that its name means.
"""

import numpy as np

from jprimfit.data.families_turned import chance, domed, turned
from jprimfit.data.shapes import Profile, box, cylinder, extrude, place, polygon, rectangle, ring, stadium
from jprimfit.data.solids import difference, intersection, union
from jprimfit.data.standard_blanks import Measured, in_units, pick, tube

_DIN_6885 = ((3, 3), (4, 4), (5, 5), (6, 6), (8, 7), (10, 8), (12, 8), (14, 9))  # width and height of the key


def dowel_pin(draw: np.random.Generator) -> Measured:
    """A cylinder with a chamfer at one end and a chamfer or a shallow ball at the other."""
    d = draw.uniform(3, 20)
    length = d * draw.uniform(1.5, 6)
    unit, (d, length) = in_units(length, d, length)
    bevel, fall = d * draw.uniform(0.04, 0.1), d * draw.uniform(0.08, 0.3)
    points = [(d / 2 - bevel, 0.0), (d / 2, fall), (d / 2, length - bevel)]
    if chance(draw, 0.4):
        return Measured(domed(points, 0.0, d / 2 * draw.uniform(1.1, 1.8)), unit)
    return Measured(turned([(0.0, 0.0), *points, (d / 2 - bevel, length), (0.0, length)]), unit)


def taper_pin(draw: np.random.Generator) -> Measured:
    """A cone of 1 in 50 on the diameter with shallow balls or planes at its ends."""
    d = draw.uniform(3, 20)
    length = d * draw.uniform(2, 7)
    unit, (d, length) = in_units(length, d, length)
    thick = d + length / 50
    points = [(d / 2, 0.0), (thick / 2, length)]
    balls = (0.55 * d * draw.uniform(1, 1.6), 0.55 * thick * draw.uniform(1, 1.6)) if chance(draw, 0.6) else (0.0, 0.0)
    return Measured(domed(points, *balls), unit)


def grooved_pin(draw: np.random.Generator) -> Measured:
    """A chamfered pin with three V grooves along a part or all of its length."""
    d = draw.uniform(3, 20)
    length = d * draw.uniform(2, 5)
    unit, (d, length) = in_units(length, d, length)
    bevel = d * draw.uniform(0.05, 0.12)
    corners = [(0.0, 0.0), (d / 2, 0.0), (d / 2, length), (0.0, length)]
    solid = turned(corners, [0.0, -bevel, -bevel, 0.0])
    deep, half = d * draw.uniform(0.1, 0.16), np.deg2rad(draw.uniform(30, 45))
    far = deep + 0.2 * d
    vee = [(d / 2 - deep, 0.0), (d / 2 - deep + far, far * np.tan(half)), (d / 2 - deep + far, -far * np.tan(half))]
    share = draw.uniform(0.45, 1.0)
    start = -0.1 * length if share > 0.8 or chance(draw, 0.6) else length * (1 - share) / 2
    groove = extrude(polygon(vee), length * 1.2 if share > 0.8 else share * length, start)
    return Measured(difference(solid, *ring(groove, 3)), unit)


def spring_pin(draw: np.random.Generator) -> Measured:
    """A slotted tube with chamfered ends."""
    d = draw.uniform(3, 20)
    length, wall, gap = d * draw.uniform(1.5, 5), d * draw.uniform(0.12, 0.22), d * draw.uniform(0.1, 0.3)
    unit, (d, length, wall, gap) = in_units(length, d, length, wall, gap)
    solid = tube(d / 2 - wall, d / 2, length, 0.0, wall * draw.uniform(0.3, 0.7))
    return Measured(difference(solid, box((d, gap, 3 * length), (d / 2, 0, length / 2))), unit)


def clevis_pin(draw: np.random.Generator) -> Measured:
    """A pin with a flat head at one end and holes for cotter pins, in one end or in both where it has no head."""
    d = draw.uniform(4, 24)
    length, dk, k = d * draw.uniform(2.5, 5), d * draw.uniform(1.35, 1.6), d * draw.uniform(0.22, 0.4)
    unit, (d, length, dk, k) = in_units(length + k, d, length, dk, k)
    bevel, hole, edge = d * draw.uniform(0.06, 0.14), d * draw.uniform(0.1, 0.15), d * draw.uniform(0.4, 0.6)
    points = [(0.0, -length), (d / 2 - bevel, -length), (d / 2, bevel - length)]
    headed = chance(draw, 0.8)
    if headed:
        points += [(d / 2, 0.0), (dk / 2, 0.0), (dk / 2, k - bevel / 2), (dk / 2 - bevel / 2, k), (0.0, k)]
    else:
        points += [(d / 2, -bevel), (d / 2 - bevel, 0.0), (0.0, 0.0)]
    holes = [cylinder(hole, 2 * d, (-d, 0, z), "x") for z in ((edge - length,) if headed else (edge - length, -edge))]
    return Measured(difference(turned(points), *holes), unit)


def drive_stud(draw: np.random.Generator) -> Measured:
    """A stud with a pilot, a round head and grooves on its shank."""
    d = draw.uniform(3, 12)
    length, dk, k = d * draw.uniform(1.5, 3.5), d * draw.uniform(1.6, 2.0), d * draw.uniform(0.55, 0.75)
    unit, (d, length, dk, k) = in_units(length + k, d, length, dk, k)
    ball = (k**2 + dk**2 / 4) / (2 * k)
    pilot, thin = length * draw.uniform(0.2, 0.35), d / 2 * draw.uniform(0.8, 0.9)
    bevel = 0.15 * d
    stem = [(0.0, -length), (thin - bevel, -length), (thin, bevel - length), (thin, pilot - length)]
    stem += [(d / 2, pilot - length), (d / 2, k / 3), (0.0, k / 3)]
    deep = 0.14 * d
    vee = polygon([(d / 2 - deep, 0.0), (d / 2 + deep, 2 * deep), (d / 2 + deep, -2 * deep)])
    high = length - pilot
    shank = difference(turned(stem), *ring(extrude(vee, 0.8 * high, -0.9 * high), int(draw.integers(2, 5))))
    return Measured(union(domed([(dk / 2, 0.0)], 0.0, ball), shank), unit)


def parallel_key(draw: np.random.Generator) -> Measured:
    """A key with two, one or no round ends, DIN 6885, its edges chamfered or not, some with screw holes."""
    b, h = pick(draw, _DIN_6885)
    length = b * draw.uniform(2.5, 6)
    unit, (b, h, length) = in_units(length, b, h, length)
    form = str(draw.choice(["round", "straight", "half"]))
    solid = extrude(stadium(length - b, b / 2) if form == "round" else rectangle(length, b), h)
    if form == "half":
        # One end of the block is cut round.
        x = (length - b) / 2
        points = np.array([(-2 * length, -b / 2), (x, -b / 2), (x, b / 2), (-2 * length, b / 2)])
        solid = intersection(solid, extrude(Profile(points, np.array([0.0, np.pi, 0.0, 0.0])), 3 * h, -h))
    if form == "straight" and chance(draw, 0.7):
        bevel = 0.06 * b
        section = polygon([(-b / 2, 0.0), (b / 2, 0.0), (b / 2, h), (-b / 2, h)], -bevel)
        solid = place(extrude(section, length, -length / 2), along="x")
    holes = []
    if chance(draw, 0.4) and length > 4 * b:
        for x in (-0.25, 0.25) if length > 5 * b else (0.0,):
            holes.append(cylinder(0.2 * b, 3 * h, (x * length, 0, -h)))
            if chance(draw, 0.5):
                holes.append(cylinder(0.32 * b, h, (x * length, 0, 0.6 * h)))
    return Measured(difference(solid, *holes), unit)
