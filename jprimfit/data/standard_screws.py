"""Standard machine screws by their heads, with slots, cross or hexagon recesses, and set screws by their points.

Heads and slots of the flat (ISO 2009), oval (ISO 2010), pan (ISO 1580) and fillister (cheese, ISO 1207) screws and the
sockets of set screws (ISO 4026) are rows of bd_warehouse's tables countersunk_head, raised_countersunk_oval_head,
pan_head, cheese_head and setscrew (standard_blanks names the version). Round and truss heads, cross and hexagon
recesses of machine screws, and the points of set screws are by proportion; lengths are any between the row's bounds.
"""

from collections.abc import Sequence

import numpy as np

from jprimfit.data.families_turned import chance, domed, turned
from jprimfit.data.shapes import Real
from jprimfit.data.solids import Solid, difference, union
from jprimfit.data.standard_blanks import CORE, Measured, cross, hexagon, in_units, pick, shank, slot

# Diameter, diameter and height of the head, width and depth of the slot, shortest and longest screw.
_ISO_2009 = (
    *((4, 7.5, 2.2, 1.06, 1.1, 5, 40), (5, 9.2, 2.5, 1.26, 1.3, 6, 50), (6, 11, 3, 1.66, 1.6, 8, 50)),
    *((8, 14.5, 4, 2.06, 2.1, 10, 55), (10, 18, 5, 2.56, 2.6, 12, 60), (12, 22, 6, 3.06, 3, 20, 80)),
)
_ISO_1580 = (
    *((4, 8, 2.4, 1.51, 1, 5, 40), (5, 9.5, 3, 1.51, 1.2, 6, 45), (6, 12, 3.6, 1.91, 1.4, 8, 45)),
    *((8, 16, 4.8, 2.31, 1.9, 10, 45), (10, 20, 6, 2.81, 2.4, 12, 45)),
)
_ISO_1207 = (
    *((4, 7, 2.6, 1.51, 1.1, 5, 40), (5, 8.5, 3.3, 1.51, 1.3, 6, 50), (6, 10, 3.9, 1.91, 1.6, 8, 60)),
    *((8, 13, 5, 2.31, 2, 10, 80), (10, 16, 6, 2.81, 2.4, 12, 80)),
)
# Diameter, diameter of the head, height of its cone (that of ISO 2009), width of the slot, radius of the dome, depth of
# the slot, lengths.
_ISO_2010 = (
    *((4, 7.5, 2.2, 1.2, 8, 1.6, 5, 40), (5, 9.2, 2.5, 1.51, 10, 2, 6, 50), (6, 11, 3, 1.91, 12, 2.4, 8, 50)),
    *((8, 14.5, 4, 2.31, 16, 3.2, 10, 55), (10, 18, 5, 2.81, 20, 4, 12, 60)),
)
# Diameter, width and depth of the hexagon, shortest and longest screw.
_ISO_4026 = (
    *((6, 3, 3.5, 6, 35), (8, 4, 5, 8, 40), (10, 5, 6, 10, 40)),
    *((12, 6, 8, 16, 40), (16, 8, 10, 20, 40), (20, 10, 12, 20, 50)),
)
_MAX_SLENDER = 6.0  # lengths in diameters


def _recess(draw: np.random.Generator, head: Real, width: Real, depth: Real, top: Real, *, reach: Real) -> Solid:
    """A slot of this width and depth, a cross or a hexagon socket in a head of diameter head that ends at z = top."""
    match draw.choice(["slot", "cross", "hexagon"], p=[0.4, 0.4, 0.2]):
        case "slot":
            return slot(width, depth, top, head)
        case "cross":
            return cross(head * draw.uniform(0.5, 0.62), min(1.3 * depth, 0.8 * reach), top)
        case _:
            return hexagon(head * draw.uniform(0.38, 0.48), min(1.2 * depth, 0.8 * reach), top, drilled=False)


def _length(draw: np.random.Generator, diameter: Real, least: Real, most: Real) -> float:
    return draw.uniform(max(least, 1.2 * diameter), min(most, _MAX_SLENDER * diameter))


def _raised(draw: np.random.Generator, row: Sequence[Real], *, side: float) -> Measured:
    """A head that stands on the plane z = 0: a cylinder up to side of its height, then a ball, cut by a recess."""
    d, dk, k, n, t, *lengths = row
    length = _length(draw, d, *lengths)
    unit, (d, dk, k, n, t, length) = in_units(k + length, d, dk, k, n, t, length)
    rise = (1 - side) * k
    ball = (rise**2 + dk**2 / 4) / (2 * rise)
    outline = [(dk / 2, 0.0), (dk / 2, side * k)] if side else [(dk / 2, 0.0)]
    solid = union(domed(outline, 0.0, ball), shank(draw, d, length, into=min(side, 0.4) * k / 2))
    return Measured(difference(solid, _recess(draw, dk, n, t, k, reach=k)), unit)


def flat_head_screw(draw: np.random.Generator) -> Measured:
    """A countersunk head of 90 degrees with a flat top, ISO 2009; lengths include the head."""
    d, dk, k, n, t, *lengths = pick(draw, _ISO_2009)
    length = k + _length(draw, d, *lengths)
    unit, (d, dk, k, n, t, length) = in_units(length, d, dk, k, n, t, length)
    return Measured(difference(_sunk(draw, d, dk, k, length, 0.0), _recess(draw, dk, n, t, k, reach=k)), unit)


def oval_head_screw(draw: np.random.Generator) -> Measured:
    """A countersunk head of 90 degrees with a raised top, ISO 2010."""
    d, dk, k, n, rf, t, *lengths = pick(draw, _ISO_2010)
    length = k + _length(draw, d, *lengths)
    unit, (d, dk, k, n, rf, t, length) = in_units(length, d, dk, k, n, rf, t, length)
    top = k + rf - float(np.sqrt(rf**2 - dk**2 / 4))
    return Measured(difference(_sunk(draw, d, dk, k, length, rf), _recess(draw, dk, n, t, top, reach=k)), unit)


def _sunk(draw: np.random.Generator, d: Real, dk: Real, k: Real, length: Real, ball: Real) -> Solid:
    """A countersunk screw from z = k - length, its cone on z = 0, its rim a cylinder, its top flat or a ball."""
    fall = (dk - d) / 2
    rim = k - fall if k > 1.05 * fall else 0.05 * k
    head = domed([(d / 2, 0.0), (dk / 2, k - rim), (dk / 2, k)], 0.0, ball)
    return union(head, shank(draw, d, length - k, into=0.0))


def pan_head_screw(draw: np.random.Generator) -> Measured:
    """A pan head, ISO 1580: low, its side straight, its top domed (the dome by proportion)."""
    return _raised(draw, pick(draw, _ISO_1580), side=draw.uniform(0.5, 0.7))


def fillister_head_screw(draw: np.random.Generator) -> Measured:
    """A fillister head: the cylinder of a cheese head, ISO 1207, with a slightly raised top (by proportion)."""
    return _raised(draw, pick(draw, _ISO_1207), side=draw.uniform(0.75, 0.88))


def round_head_screw(draw: np.random.Generator) -> Measured:
    """A round head, nearly a half ball, by proportion."""
    d = draw.uniform(3, 10)
    dk, k = d * draw.uniform(1.75, 1.95), d * draw.uniform(0.68, 0.8)
    return _raised(draw, (d, dk, k, 0.28 * d, 0.55 * k, d, 6 * d), side=0.0)


def truss_head_screw(draw: np.random.Generator) -> Measured:
    """A truss head, wide and low, by proportion."""
    d = draw.uniform(3, 10)
    dk, k = d * draw.uniform(2.2, 2.6), d * draw.uniform(0.5, 0.62)
    return _raised(draw, (d, dk, k, 0.3 * d, 0.5 * k, d, 5 * d), side=0.0)


def _set_screw(draw: np.random.Generator, point: str) -> Measured:
    """A headless screw from z = 0, where its socket or slot is, down to its point."""
    d, s, t, *lengths = pick(draw, _ISO_4026)
    length = draw.uniform(max(lengths[0], t + 0.6 * d), min(lengths[1], 3.5 * d))
    unit, (d, s, t, length) = in_units(length, d, s, t, length)
    radius, bevel = d / 2 * (CORE if chance(draw, 0.3) else 1.0), 0.09 * d
    tip = radius * draw.uniform(0.5, 0.75)
    upper = [(radius, -bevel), (radius - bevel, 0.0), (0.0, 0.0)]
    match point:
        case "cone":
            apex = radius * draw.uniform(0.7, 1.0)
            solid = turned([(0.0, -length), (radius, apex - length), *upper])
        case "oval":
            ball = draw.uniform(1.02, 1.3) * radius
            low = ball - float(np.sqrt(ball**2 - radius**2)) - length
            solid = domed([(radius, low), *upper[:2]], ball, 0.0)
        case "dog":
            reach = d * draw.uniform(0.25, 0.5)
            neck = [(0.0, -length), (tip, -length), (tip, reach - length), (radius - bevel, reach - length)]
            solid = turned([*neck, (radius, reach + bevel - length), *upper])
        case _:
            solid = turned([(0.0, -length), (tip, -length), (radius, radius - tip - length), *upper])
    cuts = [hexagon(s, min(t, 0.6 * length), 0.0, drilled=chance(draw, 0.5))]
    if point == "cup":
        deep, wide = tip * draw.uniform(0.5, 0.7), 0.85 * tip
        hollow = turned([(0.0, deep - length), (wide * (deep + 1) / deep, -1 - length), (0.0, -1 - length)])
        cuts.append(hollow)
    if chance(draw, 0.3):
        cuts[0] = slot(0.16 * d, 0.3 * d, 0.0, d)
    return Measured(difference(solid, *cuts), unit)


def cup_set_screw(draw: np.random.Generator) -> Measured:
    """A set screw whose point is hollowed by a cone."""
    return _set_screw(draw, "cup")


def cone_set_screw(draw: np.random.Generator) -> Measured:
    """A set screw with a pointed cone."""
    return _set_screw(draw, "cone")


def oval_set_screw(draw: np.random.Generator) -> Measured:
    """A set screw with a rounded point."""
    return _set_screw(draw, "oval")


def flat_set_screw(draw: np.random.Generator) -> Measured:
    """A set screw with a flat, chamfered point."""
    return _set_screw(draw, "flat")


def dog_set_screw(draw: np.random.Generator) -> Measured:
    """A set screw with a cylindrical point thinner than its thread."""
    return _set_screw(draw, "dog")
