"""Standard bolts and screws with hexagon heads, sockets and square necks.

Diameters, widths across flats, heights and sockets are the metric rows of bd_warehouse's tables hex_head,
socket_head_cap, button_head, countersunk_head, hex_head_with_flange and shoulder_screw (standard_blanks names the
version); lengths lie anywhere between the least and the largest of the row. Heavy hexagon and carriage bolts are by
proportion.
"""

import numpy as np

from jprimfit.data.families_turned import chance, domed, turned
from jprimfit.data.shapes import Real, box, cylinder
from jprimfit.data.solids import difference, union
from jprimfit.data.standard_blanks import Measured, hexagon, in_units, pick, shank, wrench_prism

# Diameter, height of the head, width across flats, shortest and longest screw.
_ISO_4014 = (
    *((5, 3.5, 8, 25, 50), (6, 4, 10, 30, 60), (8, 5.3, 13, 40, 80), (10, 6.4, 16, 45, 100), (12, 7.5, 18, 50, 120)),
    *((16, 10, 24, 65, 160), (20, 12.5, 30, 80, 200), (24, 15, 36, 90, 240)),
)
_ISO_4017 = (
    *((5, 3.74, 8, 8, 50), (6, 4.24, 10, 12, 60), (8, 5.54, 13, 16, 80), (10, 6.69, 16, 20, 100)),
    *((12, 7.79, 18, 25, 120), (16, 10.29, 24, 30, 150), (20, 12.85, 30, 40, 160), (24, 15.35, 36, 50, 180)),
)
# Diameter, thickness of the flange at its rim, its diameter, height of the head, width across flats, lengths.
_DIN_1665 = (
    *((5, 1, 11.8, 5.8, 8, 10, 50), (6, 1.1, 14.2, 6.6, 10, 12, 60), (8, 1.2, 18, 8.1, 13, 16, 80)),
    *((10, 1.5, 22.3, 10.4, 16, 20, 100), (12, 1.8, 26.6, 11.8, 18, 25, 120), (16, 2.4, 35, 15.4, 24, 35, 160)),
    (20, 3, 43, 18.9, 30, 65, 200),
)
# Diameter, diameter and height of the head, width and depth of the hexagon, lengths.
_ISO_4762 = (
    *((4, 7.22, 4, 3, 2, 6, 40), (5, 8.72, 5, 4, 2.5, 8, 50), (6, 10.22, 6, 5, 3, 8, 60), (8, 13.27, 8, 6, 4, 10, 80)),
    *((10, 16.27, 10, 8, 5, 16, 100), (12, 18.27, 12, 10, 6, 20, 120), (16, 24.33, 16, 14, 8, 25, 160)),
    *((20, 30.33, 20, 17, 10, 16, 100), (24, 36.39, 24, 19, 12, 40, 200)),
)
_ISO_7380 = (
    *((4, 7.6, 2.2, 2.58, 1.3, 6, 40), (5, 9.5, 2.75, 3.08, 1.56, 8, 50), (6, 10.5, 3.3, 4.095, 2.08, 10, 60)),
    *((8, 14, 4.4, 5.14, 2.6, 12, 80), (10, 17.5, 5.5, 6.14, 3.12, 16, 100), (12, 21, 6.6, 8.175, 4.16, 20, 100)),
    (16, 28, 8.8, 10.175, 5.2, 25, 100),
)
_ISO_10642 = (
    *((4, 8, 2.3, 2.6, 1.8, 8, 40), (5, 10, 2.8, 3.1, 2.3, 8, 50), (6, 12, 3.3, 4.12, 2.5, 8, 60)),
    *((8, 16, 4.4, 5.14, 3.5, 10, 80), (10, 20, 5.5, 6.14, 4.4, 12, 100), (12, 24, 6.5, 8.175, 4.6, 20, 100)),
    *((16, 30, 7.5, 10.175, 5.3, 30, 100), (20, 36, 8.5, 12.212, 5.9, 35, 100)),
)
# Thread, shoulder, diameter and height of the head, length of the thread, width and depth of the hexagon, lengths.
_ISO_7379 = (
    *((5, 6.5, 10, 4.5, 9.5, 3, 2.4, 10, 120), (6, 8, 13, 5.5, 11, 4, 3.3, 12, 120)),
    *((8, 10, 16, 7, 13, 5, 4.2, 16, 120), (10, 13, 18, 9, 16, 6, 4.9, 20, 120), (12, 16, 24, 11, 18, 8, 6.6, 25, 120)),
    *((16, 20, 30, 14, 22, 10, 8.8, 30, 120), (20, 25, 36, 16, 27, 12, 10, 40, 120)),
)
_MAX_SLENDER = 7.0  # lengths in diameters: longer screws show the network nothing but their shank


def _length(draw: np.random.Generator, diameter: Real, least: Real, most: Real) -> float:
    return draw.uniform(least, max(1.2 * least, min(most, _MAX_SLENDER * diameter)))


def hexagon_bolt(draw: np.random.Generator) -> Measured:
    """A hexagon head bolt with a plain part of its shank, ISO 4014."""
    d, k, s, *lengths = pick(draw, _ISO_4014)
    length = _length(draw, d, *lengths)
    unit, (d, k, s, length) = in_units(k + length, d, k, s, length)
    return Measured(union(wrench_prism(6, s, k), shank(draw, d, length, into=k / 2)), unit)


def heavy_hexagon_bolt(draw: np.random.Generator) -> Measured:
    """A heavy hexagon bolt with a washer face under its head, by proportion."""
    d = draw.uniform(12, 36)
    s, k, length = 1.6 * d + 3, draw.uniform(0.58, 0.66) * d, d * draw.uniform(1.5, 6)
    unit, (d, s, k, length) = in_units(k + length, d, s, k, length)
    face = cylinder(0.475 * s, 0.5 * k, (0, 0, -0.06 * k))
    return Measured(union(wrench_prism(6, s, k), face, shank(draw, d, length, into=k / 2)), unit)


def hexagon_cap_screw(draw: np.random.Generator) -> Measured:
    """A hexagon head screw threaded to its head, ISO 4017, with or without the washer face (by proportion)."""
    d, k, s, *lengths = pick(draw, _ISO_4017)
    length = _length(draw, d, *lengths)
    unit, (d, k, s, length) = in_units(k + length, d, k, s, length)
    bevel = d * draw.uniform(0.06, 0.15)
    stem = turned([(0.0, -length), (d / 2 - bevel, -length), (d / 2, bevel - length), (d / 2, k / 2), (0.0, k / 2)])
    solid = union(wrench_prism(6, s, k), stem)
    return Measured(union(solid, cylinder(0.47 * s, k / 2, (0, 0, -0.05 * k))) if chance(draw, 0.6) else solid, unit)


def flange_bolt(draw: np.random.Generator) -> Measured:
    """A hexagon head bolt with a conical flange under its head, DIN 1665."""
    d, c, dc, k, s, *lengths = pick(draw, _DIN_1665)
    length = _length(draw, d, *lengths)
    unit, (d, c, dc, k, s, length) = in_units(k + length, d, c, dc, k, s, length)
    slope = np.tan(np.deg2rad(25))
    rise = c + (dc - s) / 2 * slope
    skirt = turned([(0.0, 0.0), (dc / 2, 0.0), (dc / 2, c), (s / 2, rise), (0.0, rise)])
    return Measured(union(skirt, wrench_prism(6, s, k), shank(draw, d, length, into=k / 2)), unit)


def carriage_bolt(draw: np.random.Generator) -> Measured:
    """A bolt with a round head and a square neck, by proportion."""
    d = draw.uniform(5, 20)
    head, k, neck = d * draw.uniform(1.9, 2.3), d * draw.uniform(0.45, 0.6), d * draw.uniform(0.5, 0.9)
    length = neck + d * draw.uniform(1.5, 5.5)
    unit, (d, head, k, neck, length) = in_units(k + length, d, head, k, neck, length)
    ball = (k**2 + head**2 / 4) / (2 * k)
    cap = domed([(head / 2, 0.0)], 0.0, ball)
    square = box((d * 1.02, d * 1.02, neck + k / 2), (0, 0, k / 4 - neck / 2))
    return Measured(union(cap, square, shank(draw, d, length, into=0.0)), unit)


def socket_cap_screw(draw: np.random.Generator) -> Measured:
    """A cylindrical head with a hexagon socket, ISO 4762."""
    d, dk, k, s, t, *lengths = pick(draw, _ISO_4762)
    length = _length(draw, d, *lengths)
    unit, (d, dk, k, s, t, length) = in_units(k + length, d, dk, k, s, t, length)
    bevel = -dk * draw.uniform(0.03, 0.06)
    head = turned([(0.0, 0.0), (dk / 2, 0.0), (dk / 2, k), (0.0, k)], [0.0, 0.0, bevel, 0.0])
    solid = union(head, shank(draw, d, length, into=k / 4))
    return Measured(difference(solid, hexagon(s, t, k, drilled=chance(draw, 0.7))), unit)


def button_head_screw(draw: np.random.Generator) -> Measured:
    """A low round head with a hexagon socket, ISO 7380; its flat top by proportion."""
    d, dk, k, s, t, *lengths = pick(draw, _ISO_7380)
    length = _length(draw, d, *lengths)
    unit, (d, dk, k, s, t, length) = in_units(k + length, d, dk, k, s, t, length)
    rise = 1.25 * k  # of the whole ball: its flat is then wider than the socket
    ball = (rise**2 + dk**2 / 4) / (2 * rise)
    flat = cylinder(dk, 2 * k, (0, 0, k))
    head = difference(domed([(dk / 2, 0.0)], 0.0, ball), flat)
    solid = union(head, shank(draw, d, length, into=k / 4))
    return Measured(difference(solid, hexagon(s, t, k, drilled=chance(draw, 0.5))), unit)


def socket_flat_screw(draw: np.random.Generator) -> Measured:
    """A countersunk head of 90 degrees with a hexagon socket, ISO 10642; lengths include the head."""
    d, dk, k, s, t, *lengths = pick(draw, _ISO_10642)
    length = max(_length(draw, d, *lengths), 1.5 * k)
    unit, (d, dk, k, s, t, length) = in_units(length, d, dk, k, s, t, length)
    rim = min((dk - d) / 2, 0.9 * k)
    head = turned([(0.0, -rim), (dk / 2 - rim, -rim), (dk / 2, 0.0), (dk / 2, k - rim), (0.0, k - rim)])
    solid = union(head, shank(draw, d, length - k, into=0.0))
    return Measured(difference(solid, hexagon(s, t, k - rim, drilled=chance(draw, 0.7))), unit)


def shoulder_screw(draw: np.random.Generator) -> Measured:
    """A ground shoulder between a socket head and a thinner thread, ISO 7379; the groove by proportion."""
    d, ds, dk, k, b, s, t, *lengths = pick(draw, _ISO_7379)
    length = _length(draw, ds, *lengths)
    unit, (d, ds, dk, k, b, s, t, length) = in_units(k + length + b, d, ds, dk, k, b, s, t, length)
    low, groove, bevel = -length - b, b * draw.uniform(0.12, 0.2), 0.12 * d
    stem = [(0.0, low), (d / 2 - bevel, low), (d / 2, low + bevel), (d / 2, -length - groove)]
    stem += [(0.4 * d, -length - groove), (0.4 * d, -length), (ds / 2 - bevel, -length), (ds / 2, bevel - length)]
    stem += [(ds / 2, 0.0), (dk / 2, 0.0), (dk / 2, k - 0.05 * dk), (0.45 * dk, k), (0.0, k)]
    return Measured(difference(turned(stem), hexagon(s, t, k, drilled=chance(draw, 0.7))), unit)
