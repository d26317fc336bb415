"""Standard nuts and washers.

Heights, widths across flats and diameters are the metric rows of bd_warehouse's tables hex_nut (ISO 4032, 4035),
square_nut (DIN 557), domed_cap_nut (DIN 1587), hex_nut_with_flange (DIN 1665), plain_washer (ISO 7089, 7093) and
chamfered_washer (ISO 7090; standard_blanks names the version). The tables have discrete sizes; every height is drawn
within 5 % of its row's, so that no two parts are alike. Slotted and coupling nuts, spherical and conical washers,
bores and chamfers are by proportion.
"""

from collections.abc import Sequence

import numpy as np

from jprimfit.data.families_turned import chance, domed, turned
from jprimfit.data.shapes import Profile, Real, box, drill, place, revolve, ring
from jprimfit.data.solids import Solid, difference, union
from jprimfit.data.standard_blanks import CORE, Measured, in_units, pick, tube, wrench_prism

# Diameter, height, width across flats.
_ISO_4032 = (
    *((5, 4.7, 8), (6, 5.2, 10), (8, 6.8, 13), (10, 8.4, 16), (12, 10.8, 18), (16, 14.8, 24), (20, 18, 30)),
    (24, 21.5, 36),
)
_ISO_4035 = (
    *((5, 2.7, 8), (6, 3.2, 10), (8, 4, 13), (10, 5, 17), (12, 6, 19), (16, 8, 24), (20, 10, 30), (24, 12, 36)),
)
_DIN_557 = ((5, 4, 8), (6, 5, 10), (8, 6.5, 13), (10, 8, 17), (12, 10, 19), (16, 13, 24))
# Diameter, diameter of the dome, height of the hexagon, width across flats.
_DIN_1587 = (
    *((5, 7.5, 4, 8), (6, 9.5, 5, 10), (8, 12.5, 6.5, 13), (10, 15, 8.8, 16), (12, 17, 10, 18), (16, 23, 13, 24)),
    *((20, 28, 16, 30), (24, 34, 19, 36)),
)
# Diameter, thickness of the flange at its rim, its diameter, height, width across flats.
_DIN_1665 = (
    *((5, 1, 11.8, 5, 8), (6, 1.1, 14.2, 6, 10), (8, 1.2, 17.9, 8, 13), (10, 1.5, 21.8, 10, 15), (12, 1.8, 26, 12, 18)),
    *((16, 2.4, 34.5, 16, 24), (20, 3, 42.8, 20, 30)),
)
# Inner and outer diameter, thickness.
_WASHERS = (
    *((5.3, 10, 1.1), (6.4, 12, 1.8), (8.4, 16, 1.8), (10.5, 20, 2.2), (13, 24, 2.7), (17, 30, 3.3), (21, 37, 3.3)),
    *((25, 44, 4.3), (5.3, 15, 1.4), (6.4, 18, 1.8), (8.4, 24, 2.2), (10.5, 30, 2.7), (13, 37, 3.3), (22, 60, 4.6)),
)
_ISO_7090 = (
    *((5.3, 10, 1.1), (6.4, 12, 1.8), (8.4, 16, 1.8), (10.5, 20, 2.2), (13, 24, 2.7), (17, 30, 3.3), (21, 37, 3.3)),
    *((25, 44, 4.3), (41, 72, 6.6), (46, 85, 8), (54, 98, 9)),
)


def _near(draw: np.random.Generator, value: Real) -> float:
    return value * draw.uniform(0.95, 1.05)


def _bore(draw: np.random.Generator, diameter: Real, height: Real) -> list[Solid]:
    """The bore of a thread, of its nominal or core diameter, countersunk at both ends or not."""
    radius = diameter / 2 * (CORE if chance(draw, 0.6) else 1.0)
    sunk = draw.uniform(0.04, 0.09) * diameter if chance(draw, 0.7) else 0.0
    upper = place(drill(radius, 2 * height, 0.0, sunk), (0, 0, height))
    return [upper, place(drill(radius, 0.4 * height, 0.0, sunk), along="-z")] if sunk else [upper]


def _plain(draw: np.random.Generator, row: Sequence[Real], sides: int, *, both: bool) -> Measured:
    d, m, s = row
    unit, (d, m, s) = in_units(s / np.cos(np.pi / sides), d, _near(draw, m), s)
    return Measured(difference(wrench_prism(sides, s, m, both=both), *_bore(draw, d, m)), unit)


def hexagon_nut(draw: np.random.Generator) -> Measured:
    """A hexagon nut, ISO 4032."""
    return _plain(draw, pick(draw, _ISO_4032), 6, both=chance(draw, 0.7))


def jam_nut(draw: np.random.Generator) -> Measured:
    """A thin hexagon nut chamfered on both sides, ISO 4035."""
    return _plain(draw, pick(draw, _ISO_4035), 6, both=True)


def square_nut(draw: np.random.Generator) -> Measured:
    """A square nut, DIN 557."""
    return _plain(draw, pick(draw, _DIN_557), 4, both=False)


def coupling_nut(draw: np.random.Generator) -> Measured:
    """A long hexagon nut, two and a half to four diameters, by proportion; its section is that of ISO 4032."""
    d, _, s = pick(draw, _ISO_4032)
    m = d * draw.uniform(2.3, 4.0)
    unit, (d, m, s) = in_units(m, d, m, s)
    return Measured(difference(wrench_prism(6, s, m, both=True), *_bore(draw, d, m)), unit)


def slotted_nut(draw: np.random.Generator) -> Measured:
    """A hexagon nut with six slots for a cotter pin in its upper part, or in a round crown, by proportion."""
    d, m, s = pick(draw, _ISO_4032)
    crown = chance(draw, 0.5)
    m, deep, wide = m * draw.uniform(1.05, 1.3), d * draw.uniform(0.3, 0.4), d * draw.uniform(0.18, 0.26)
    unit, (d, m, s, deep, wide) = in_units(s * 1.155, d, m, s, deep, wide)
    solid = wrench_prism(6, s, m, both=not crown)
    if crown:
        top = tube(0.3 * d, draw.uniform(0.42, 0.47) * s, deep + 0.2 * m, 0.8 * m, 0.05 * d)
        solid, m = union(solid, top), m + deep
    cuts = ring(box((4 * s, wide, 2 * deep), (0, 0, m)), 3, np.pi / 6)
    return Measured(difference(solid, *_bore(draw, d, m), *cuts), unit)


def cap_nut(draw: np.random.Generator) -> Measured:
    """A domed cap nut, DIN 1587, with a blind bore."""
    d, dk, m, s = pick(draw, _DIN_1587)
    unit, (d, dk, m, s) = in_units(max(m + dk / 2, s * 1.155), d, dk, _near(draw, m), s)
    straight = d * draw.uniform(0.05, 0.25)
    dome = domed([(dk / 2, m / 2), (dk / 2, m + straight)], 0.0, dk / 2 * draw.uniform(1.0, 1.1))
    hole = place(drill(d / 2 * CORE, m + straight, 1.03, 0.06 * d if chance(draw, 0.6) else 0.0), along="-z")
    return Measured(difference(union(wrench_prism(6, s, m, both=True), dome), hole), unit)


def flange_nut(draw: np.random.Generator) -> Measured:
    """A hexagon nut with a conical flange, DIN 1665."""
    d, c, dc, m, s = pick(draw, _DIN_1665)
    unit, (d, c, dc, m, s) = in_units(dc, d, c, dc, _near(draw, m), s)
    rise = c + (dc - s) / 2 * np.tan(np.deg2rad(25))
    skirt = turned([(0.0, 0.0), (dc / 2, 0.0), (dc / 2, c), (s / 2, rise), (0.0, rise)])
    return Measured(difference(union(skirt, wrench_prism(6, s, m)), *_bore(draw, d, m)), unit)


def plain_washer(draw: np.random.Generator) -> Measured:
    """A flat washer, ISO 7089 or the wide ISO 7093."""
    inner, outer, high = pick(draw, _WASHERS)
    unit, (inner, outer, high) = in_units(outer, inner, outer, _near(draw, high))
    return Measured(tube(inner / 2, outer / 2, high), unit)


def chamfered_washer(draw: np.random.Generator) -> Measured:
    """A washer with one chamfered edge, ISO 7090."""
    inner, outer, high = pick(draw, _ISO_7090)
    unit, (inner, outer, high) = in_units(outer, inner, outer, _near(draw, high))
    fall, width = high * draw.uniform(0.25, 0.5), high * draw.uniform(0.35, 0.75)
    corners = [
        (inner / 2, 0.0),
        (outer / 2, 0.0),
        (outer / 2, high - fall),
        (outer / 2 - width, high),
        (inner / 2, high),
    ]
    return Measured(turned(corners), unit)


def spherical_washer(draw: np.random.Generator) -> Measured:
    """One of a pair of washers that let a bolt lean: one with a ball, or a seat with a cone, by proportion."""
    d = draw.uniform(6, 36)
    inner, outer = d * draw.uniform(1.05, 1.2), d * draw.uniform(1.9, 2.2)
    unit, (d, inner, outer) = in_units(outer, d, inner, outer)
    ball = outer * draw.uniform(0.62, 0.9)
    if chance(draw, 0.6):
        rim = d * draw.uniform(0.1, 0.3)
        center = rim - float(np.sqrt(ball**2 - outer**2 / 4))
        top = center + float(np.sqrt(ball**2 - inner**2 / 4))
        points = [(inner / 2, 0.0), (outer / 2, 0.0), (outer / 2, rim), (inner / 2, top)]
        sweep = float(np.arcsin(outer / 2 / ball) - np.arcsin(inner / 2 / ball))
        return Measured(revolve(Profile(np.array(points), np.array([0.0, 0.0, sweep, 0.0]))), unit)
    high, flat = d * draw.uniform(0.35, 0.5), d * draw.uniform(0.06, 0.14)
    fall = min(0.8 * high, 0.85 * ((outer - inner) / 2 - flat))
    points = [(inner / 2, 0.0), (outer / 2, 0.0), (outer / 2, high), (outer / 2 - flat, high)]
    return Measured(turned([*points, (outer / 2 - flat - fall, high - fall), (inner / 2, high - fall)]), unit)
