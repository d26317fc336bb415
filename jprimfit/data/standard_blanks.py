"""What standard parts have in common: sizes in millimetres, wrench heads, shanks, recesses.

A family of standard parts draws its dimensions in millimetres and brings them with in_units to a solid SPAN units long,
for which shapes.py cuts circles finely enough; Measured carries the unit back. Where the numbers come from stands in
each file: bd_warehouse is the package of that name, version 0.4.0 (Apache 2.0), whose tables of dimensions were read;
whatever is not in a table there is by proportion, which no standard vouches for. Threads are left out, as in
TraceParts: a thread is the cylinder of its nominal or of its core diameter. Heads stand on z = 0, shanks hang below.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from jprimfit.data.families_turned import chance, turned
from jprimfit.data.shapes import Real, box, extrude, place, polygon, regular, revolve, rotate
from jprimfit.data.shapes import cone as frustum
from jprimfit.data.solids import Solid, intersection, union

SPAN = 12.0  # units of the longest side of a standard part: triangles are then within 0.5 % of areas of discs
CORE = 0.85  # core diameter of a thread in nominal diameters, by proportion
_CHAMFER = np.deg2rad(30)  # of wrench heads and nuts, from the plane of their end
_CHAMFER_CIRCLE = 0.95  # diameter of the circle that the chamfer leaves, in widths across flats

Row = TypeVar("Row")


class Measured(NamedTuple):
    """A solid and the length in millimetres of its unit."""

    solid: Solid
    unit: float


def pick(draw: np.random.Generator, rows: Sequence[Row]) -> Row:
    """One of the rows of a table."""
    return rows[int(draw.integers(len(rows)))]


def in_units(longest: Real, *sizes: Real) -> tuple[float, list[float]]:
    """The unit in millimetres that makes longest SPAN units long, and the sizes (millimetres) in that unit."""
    unit = float(longest) / SPAN
    return unit, [float(size) / unit for size in sizes]


def wrench_prism(sides: int, across: Real, height: Real, *, both: bool = False) -> Solid:
    """The prism from z = 0 to height with this width across flats, chamfered at its upper end or at both."""
    flat = _CHAMFER_CIRCLE * across / 2
    beyond = across / 2 / np.cos(np.pi / sides) * 1.05
    fall = (beyond - flat) * np.tan(_CHAMFER)
    # The blank ends apart from the ends of the prism, so that no two faces coincide.
    foot = [(0.0, 0.0), (flat, 0.0), (beyond, fall)] if both else [(0.0, -0.1 * height), (beyond, -0.1 * height)]
    rim = turned([*foot, (beyond, height - fall), (flat, height), (0.0, height)])
    base = -0.1 * height if both else 0.0
    return intersection(extrude(regular(sides, across), 1.1 * height - base, base), rim)


def shank(draw: np.random.Generator, diameter: Real, length: Real, *, into: Real) -> Solid:
    """The body of a screw from z = into, within its head, down to -length: chamfered, its thread thinner or not."""
    body = diameter / 2
    end = body * CORE if chance(draw, 0.5) else body
    bevel = end * draw.uniform(0.12, 0.3)
    points = [(0.0, -length), (end - bevel, -length), (end, bevel - length)]
    if end < body:
        start = -length * draw.uniform(0.15, 0.6)
        points += [(end, start), (body, start)]
    return turned([*points, (body, into), (0.0, into)])


def slot(width: Real, depth: Real, top: Real, reach: Real) -> Solid:
    """What a straight slot through the middle of a head removes that ends at z = top; reach is beyond the head."""
    height = 3 * depth
    return box((2 * reach, width, height), (0, 0, top - depth + height / 2))


def cross(width: Real, depth: Real, top: Real) -> Solid:
    """What a cross recess of this width at z = top removes: two tapered wings (by proportion)."""
    low, high, rise = 0.22 * width, 0.5 * width, 2 * depth
    outer = high + (high - low) * (rise - depth) / depth
    wing = polygon([(-low, 0.0), (low, 0.0), (outer, rise), (-outer, rise)])
    thick = 0.24 * width
    one = rotate(extrude(wing, thick, -thick / 2), np.pi / 2, "x")
    return place(union(one, rotate(one, np.pi / 2)), (0, 0, top - depth))


def hexagon(across: Real, depth: Real, top: Real, *, drilled: bool) -> Solid:
    """What a hexagon socket that ends at z = top removes; its bottom flat or with the cone of a drill."""
    socket = extrude(regular(6, across), 3 * depth, top - depth)
    if not drilled:
        return socket
    radius = 0.46 * across
    fall = radius / np.tan(np.deg2rad(60))
    tip = frustum(0.0, 1.08 * radius, 1.08 * fall, (0, 0, top - depth - fall))  # it reaches into the socket
    return union(socket, tip)


def tube(inner: Real, outer: Real, length: Real, base: Real = 0.0, bevel: Real = 0.0) -> Solid:
    """The pipe about z of these radii from z = base up, its outer edges chamfered by bevel."""
    corners = [(inner, base), (outer, base), (outer, base + length), (inner, base + length)]
    return revolve(polygon(corners, [0.0, -bevel, -bevel, 0.0]))
