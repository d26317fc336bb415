"""Standard structural shapes, cut to length, and brackets made of them, by proportion.

Sections in the manner of rolled steel: webs and flanges with fillets at their roots, flanges parallel or tapered.
"""

from collections.abc import Sequence

import numpy as np

from jprimfit.data.families_turned import chance
from jprimfit.data.shapes import Real, box, cylinder, extrude, place, polygon, rotate
from jprimfit.data.solids import Solid, difference, union
from jprimfit.data.standard_blanks import Measured, in_units


def _beam(
    draw: np.random.Generator, points: Sequence[Sequence[Real]], radii: Sequence[Real], longest: Real
) -> Measured:
    """The section drawn in millimetres, cut to a length between 0.5 and 4 of its longest side."""
    length = longest * draw.uniform(0.5, 4)
    unit, (length,) = in_units(max(length, longest), length)
    outline = polygon([(x / unit, y / unit) for x, y in points], [radius / unit for radius in radii])
    return Measured(place(extrude(outline, length, -length / 2), along="x"), unit)


def angle_profile(draw: np.random.Generator) -> Measured:
    """An L: two legs, equal or not, a fillet between them and rounded toes."""
    long = draw.uniform(30, 200)
    short = long if chance(draw, 0.5) else long * draw.uniform(0.5, 0.85)
    t = short * draw.uniform(0.08, 0.2)
    root, toe = t * draw.uniform(0.8, 1.3), t * draw.uniform(0.3, 0.7) if chance(draw, 0.7) else 0.0
    points = [(0.0, 0.0), (short, 0.0), (short, t), (t, t), (t, long), (0.0, long)]
    return _beam(draw, points, [0.0, 0.0, toe, root, toe, 0.0], long)


def channel_profile(draw: np.random.Generator) -> Measured:
    """A C: a web and two flanges, parallel or with inner faces that slope by 1 in 6."""
    h = draw.uniform(60, 300)
    b = h * draw.uniform(0.3, 0.5)
    web, t = b * draw.uniform(0.1, 0.18), b * draw.uniform(0.12, 0.2)
    slope = 1 / 6 if chance(draw, 0.6) else 0.0
    thick = t + (b - web) / 2 * slope
    toe, root = (t - (b - web) / 2 * slope) * 0.6 * chance(draw, 0.7), t * draw.uniform(0.7, 1.1)
    thin = 2 * t - thick
    low = [(0.0, -h / 2), (b, -h / 2), (b, thin - h / 2), (web, thick - h / 2)]
    points = low + [(x, -y) for x, y in reversed(low)]
    return _beam(draw, points, [0.0, 0.0, toe, root, root, toe, 0.0, 0.0], h)


def _double(draw: np.random.Generator, h: Real, b: Real, web: Real, t: Real) -> Measured:
    """A doubly symmetric section of height h and width b with fillets between its web and its flanges."""
    root = t * draw.uniform(0.6, 1.2)
    quarter = [(b / 2, -h / 2), (b / 2, t - h / 2), (web / 2, t - h / 2)]
    right = quarter + [(x, -y) for x, y in reversed(quarter)]
    points = right + [(-x, -y) for x, y in right]
    return _beam(draw, points, [0.0, 0.0, root, root, 0.0, 0.0] * 2, max(h, b))


def wide_flange_profile(draw: np.random.Generator) -> Measured:
    """A W: an I whose flanges are thicker than its web."""
    h = draw.uniform(100, 600)
    b = h * draw.uniform(0.35, 1.0)
    t = 0.03 * h + 0.03 * b + h * draw.uniform(0.0, 0.02)
    return _double(draw, h, b, t * draw.uniform(0.5, 0.75), t)


def bearing_pile_profile(draw: np.random.Generator) -> Measured:
    """An HP: about as wide as high, web and flanges equally thick."""
    h = draw.uniform(200, 360)
    t = h * draw.uniform(0.035, 0.065)
    return _double(draw, h, h * draw.uniform(0.98, 1.05), t, t)


def tee_profile(draw: np.random.Generator) -> Measured:
    """A T: half of an I, its stem straight or tapered."""
    h = draw.uniform(40, 250)
    b, stem = h * draw.uniform(0.7, 1.5), h * draw.uniform(0.06, 0.12)
    t, end = stem * draw.uniform(1.0, 1.6), stem * (draw.uniform(0.6, 0.9) if chance(draw, 0.4) else 1.0)
    root = t * draw.uniform(0.6, 1.2)
    points = [(-end / 2, -h), (end / 2, -h), (stem / 2, -t), (b / 2, -t), (b / 2, 0.0), (-b / 2, 0.0), (-b / 2, -t)]
    return _beam(draw, [*points, (-stem / 2, -t)], [0, 0, root, 0, 0, 0, 0, root], max(h, b))


def gusset_bracket(draw: np.random.Generator) -> Measured:
    """An angle bracket: two drilled plates at a right angle with a bend or one or two triangular gussets."""
    long = draw.uniform(30, 150)
    high, deep, t = long * draw.uniform(0.6, 1.0), long * draw.uniform(0.5, 1.2), long * draw.uniform(0.06, 0.12)
    unit, (long, high, deep, t) = in_units(max(long, deep), long, high, deep, t)
    bent = chance(draw, 0.4)
    points = [(0.0, 0.0), (long, 0.0), (long, t), (t, t), (t, high), (0.0, high)]
    outline = polygon(points, [2.0 * t, 0.0, 0.0, t, 0.0, 0.0] if bent else 0.0)
    solid: Solid = rotate(extrude(outline, deep, -deep / 2), np.pi / 2, "x")
    sides: tuple[float, ...] = (0.0,)
    if not bent:
        reach = draw.uniform(0.55, 0.9)
        triangle = polygon(
            [(t / 2, t / 2), (reach * long, t / 2), (reach * long, t), (t, reach * high), (t / 2, reach * high)]
        )
        rib = rotate(extrude(triangle, t, -t / 2), np.pi / 2, "x")
        sides = (0.0,) if chance(draw, 0.5) else (t / 2 - deep / 2, deep / 2 - t / 2)
        solid = union(solid, *(place(rib, (0, y, 0)) for y in sides))
    size = min(long, deep, high) * draw.uniform(0.07, 0.12)
    row = (-deep / 4, deep / 4) if sides == (0.0,) else (0.0,)
    cuts: list[Solid] = [cylinder(size, 4 * t, (0.6 * long, y, -t)) for y in row]
    if chance(draw, 0.5) and long - 5 * size > 0.5 * long:
        cuts.append(box((long * 0.2, 2 * size, 4 * t), (0.6 * long, row[0], 0)))
    cuts += [cylinder(size, 4 * t, (-t, y, 0.6 * high), "x") for y in row]
    return Measured(difference(solid, *cuts), unit)
