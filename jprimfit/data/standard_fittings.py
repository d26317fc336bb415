"""Standard pipes, pipe fittings and valve housings.

Outside diameters and walls are rows of bd_warehouse's table pipe: steel pipe of schedules 40 and 80 by nominal size
(standard_blanks names the version), converted from inches. Lengths, ends, hexagons and everything about a fitting but
the pipe that it fits are by proportion. Elbows are left out: their bends are tori.
"""

import numpy as np

from jprimfit.data.families_turned import chance, domed, turned
from jprimfit.data.shapes import Real, cylinder, disc, drill, extrude, place, regular, ring, sphere
from jprimfit.data.solids import Solid, difference, union
from jprimfit.data.standard_blanks import Measured, in_units, pick, tube, wrench_prism

_INCH = 25.4
# Outside diameter and the walls of schedules 40 and 80, inches.
_STEEL_PIPE = (
    *((0.54, 0.088, 0.119), (0.675, 0.091, 0.126), (0.84, 0.109, 0.147), (1.05, 0.113, 0.154), (1.315, 0.133, 0.179)),
    *((1.66, 0.14, 0.191), (1.9, 0.145, 0.2), (2.375, 0.154, 0.218), (2.875, 0.203, 0.276), (3.5, 0.216, 0.3)),
    *((4.5, 0.237, 0.337), (5.563, 0.258, 0.375)),
)


def _pipe(draw: np.random.Generator, least: int = 0) -> tuple[float, float]:
    """Outer and inner radius in millimetres of a pipe of at least this row."""
    outside, *walls = pick(draw, _STEEL_PIPE[least:])
    return outside / 2 * _INCH, (outside / 2 - pick(draw, walls)) * _INCH


def _step_down(draw: np.random.Generator, outer: Real, *, share: float = 0.9) -> tuple[float, float]:
    """A pipe whose outside is at most this share of outer (both radii)."""
    small = [row for row in _STEEL_PIPE if row[0] / 2 * _INCH <= share * outer]
    outside, wall, _ = pick(draw, small[-4:])
    return outside / 2 * _INCH, (outside / 2 - wall) * _INCH


def steel_pipe(draw: np.random.Generator) -> Measured:
    """A length of pipe, its ends plain or bevelled for welding."""
    outer, inner = _pipe(draw)
    length = 2 * outer * draw.uniform(0.8, 5)
    unit, (outer, inner, length) = in_units(max(length, 2 * outer), outer, inner, length)
    bevel = (outer - inner) * draw.uniform(0.4, 0.8) if chance(draw, 0.5) else 0.0
    return Measured(tube(inner, outer, length, 0.0, bevel), unit)


def pipe_nipple(draw: np.random.Generator) -> Measured:
    """A short pipe with thinner threads at its ends."""
    outer, inner = _pipe(draw)
    length = 2 * outer * draw.uniform(1.2, 3)
    unit, (outer, inner, length) = in_units(length, outer, inner, length)
    run, thin = length * draw.uniform(0.2, 0.35), outer - (outer - inner) * draw.uniform(0.3, 0.5)
    bevel = (thin - inner) * 0.4
    low = [(thin - bevel, 0.0), (thin, bevel), (thin, run), (outer, run)]
    high = [(r, length - z) for r, z in reversed(low)]
    return Measured(turned([(inner, 0.0), *low, *high, (inner, length)]), unit)


def hexagon_nipple(draw: np.random.Generator) -> Measured:
    """Two threaded ends, equal or not, with a hexagon between them."""
    outer, inner = _pipe(draw, 2)
    other, bore = _step_down(draw, outer) if chance(draw, 0.5) else (outer, inner)
    run, high = outer * draw.uniform(0.9, 1.4), outer * draw.uniform(0.4, 0.8)
    unit, (outer, inner, other, bore, run, high) = in_units(2 * run + high, outer, inner, other, bore, run, high)
    bevel = 0.4 * (outer - inner)
    one = turned([(0.0, -run), (outer - bevel, -run), (outer, bevel - run), (outer, high / 2), (0.0, high / 2)])
    end = high + run * other / outer
    two = turned([(0.0, high / 2), (other, high / 2), (other, end - bevel), (other - bevel, end), (0.0, end)])
    across = 2 * outer * draw.uniform(1.12, 1.3)
    cuts = [
        cylinder(bore, 4 * end, (0, 0, -2 * end)),
        cylinder(inner, run + high / 2, (0, 0, -run * 1.0 - 0.001 * run)),
    ]
    return Measured(difference(union(wrench_prism(6, across, high, both=True), one, two), *cuts), unit)


def pipe_reducer(draw: np.random.Generator) -> Measured:
    """A concentric reducer for welding: two short pipes and the hollow cone between them."""
    outer, inner = _pipe(draw, 3)
    end, bore = _step_down(draw, outer)
    length = 2 * outer * draw.uniform(0.8, 1.5)
    unit, (outer, inner, end, bore, length) = in_units(max(length, 2 * outer), outer, inner, end, bore, length)
    low, high = length * draw.uniform(0.12, 0.3), length * draw.uniform(0.7, 0.88)
    points = [(outer, 0.0), (outer, low), (end, high), (end, length), (bore, length), (bore, high), (inner, low)]
    return Measured(turned([*points, (inner, 0.0)]), unit)


def pipe_cap(draw: np.random.Generator) -> Measured:
    """A cap: a short pipe closed by a spherical or a flat end, some with a hexagon or a square on top."""
    outer, inner = _pipe(draw, 2)
    length = outer * draw.uniform(0.8, 1.6)
    unit, (outer, inner, length) = in_units(max(2 * outer, length), outer, inner, length)
    wall = outer - inner
    if chance(draw, 0.6):
        ball = outer * draw.uniform(1.05, 1.7)
        hole = domed([(inner, -length), (inner, length)], 0.0, np.hypot(inner, np.sqrt(ball**2 - outer**2)))
        return Measured(difference(domed([(outer, 0.0), (outer, length)], 0.0, ball), hole), unit)
    bevel, roof = 0.4 * wall, wall * draw.uniform(1.5, 2.5)
    collar = outer + wall * draw.uniform(0.6, 1.2)
    body = turned([(0.0, 0.0), (collar, 0.0), (collar, length - bevel), (collar - bevel, length), (0.0, length)])
    hole = place(drill(outer, length - roof, 0.0, 0.3 * wall), along="-z")
    if chance(draw, 0.5):
        drive = extrude(
            regular(int(draw.choice([4, 6])), outer * draw.uniform(0.9, 1.2)), 0.7 * outer, length - roof / 2
        )
        body = union(body, drive)
    return Measured(difference(body, hole), unit)


def _coupled(draw: np.random.Generator, first: Real, second: Real, bore: Real, unit: Real, wall: Real) -> Measured:
    """A sleeve with sockets for pipes of two radii, its outside a hexagon, or round, stepped where they differ."""
    deep, other = first * draw.uniform(0.8, 1.2), second * draw.uniform(0.8, 1.2)
    web = wall * draw.uniform(0.6, 1.5)
    length = deep + web + other
    low, high = first + wall, second + wall
    if first == second and chance(draw, 0.4):
        solid: Solid = extrude(regular(int(draw.choice([6, 8])), 2 * low), length)
    elif first == second:
        solid = tube(0.0, low, length, 0.0, wall * draw.uniform(0.1, 0.5))
    else:
        middle = deep + web * draw.uniform(0.2, 0.8)
        end = min(middle + (low - high) * draw.uniform(0.3, 1.0), length * 0.9)
        solid = turned([(0.0, 0.0), (low, 0.0), (low, middle), (high, end), (high, length), (0.0, length)])
    sockets = [
        place(drill(first, deep, 0.0, 0.3 * wall), along="-z"),
        place(drill(second, other, 0.0, 0.3 * wall), (0, 0, length)),
    ]
    return Measured(difference(solid, *sockets, cylinder(bore, 3 * length, (0, 0, -length))), unit)


def pipe_coupling(draw: np.random.Generator) -> Measured:
    """A sleeve that joins two equal pipes."""
    outer, inner = _pipe(draw)
    unit, (outer, inner) = in_units(3 * outer, outer, inner)
    return _coupled(draw, outer, outer, inner, unit, outer * draw.uniform(0.15, 0.3))


def reducing_coupling(draw: np.random.Generator) -> Measured:
    """A sleeve that joins two pipes of different size."""
    outer, _ = _pipe(draw, 3)
    small, bore = _step_down(draw, outer)
    unit, (outer, small, bore) = in_units(3 * outer, outer, small, bore)
    return _coupled(draw, outer, small, bore, unit, outer * draw.uniform(0.15, 0.3))


def pipe_bushing(draw: np.random.Generator) -> Measured:
    """A reducer within a fitting: a thread outside, a smaller one inside, a hexagon or a round collar."""
    outer, _ = _pipe(draw, 3)
    small, bore = _step_down(draw, outer, share=0.8)
    run, high = outer * draw.uniform(0.7, 1.2), outer * draw.uniform(0.25, 0.5)
    unit, (outer, small, bore, run, high) = in_units(max(run + high, 2.2 * outer), outer, small, bore, run, high)
    bevel = 0.12 * (outer - small)
    stem = turned([(0.0, -run), (outer - bevel, -run), (outer, bevel - run), (outer, high / 2), (0.0, high / 2)])
    wide = outer * draw.uniform(1.06, 1.25)
    head = wrench_prism(6, 2 * wide, high) if chance(draw, 0.7) else tube(0.0, wide, high, 0.0, 0.1 * high)
    depth = (run + high) * draw.uniform(0.5, 0.8)
    cuts = [place(drill(small, depth, 0.0, bevel), (0, 0, high)), cylinder(bore, 4 * run, (0, 0, -2 * run))]
    return Measured(difference(union(stem, head), *cuts), unit)


def pipe_union(draw: np.random.Generator) -> Measured:
    """Two socketed ends drawn together by a hexagon nut."""
    outer, inner = _pipe(draw)
    wall, deep = outer * draw.uniform(0.15, 0.25), outer * draw.uniform(0.7, 1.1)
    nut, first, second = outer * draw.uniform(0.6, 0.9), outer * draw.uniform(0.5, 0.9), outer * draw.uniform(0.6, 1.1)
    length = first + nut + second
    unit, (outer, inner, wall, deep, nut, first, second) = in_units(
        length, outer, inner, wall, deep, nut, first, second
    )
    length = first + nut + second
    body = outer + wall
    solid: Solid = tube(0.0, body, length, 0.0, 0.3 * wall)
    solid = union(solid, place(wrench_prism(6, 2 * body * draw.uniform(1.3, 1.5), nut, both=True), (0, 0, first)))
    if chance(draw, 0.6):
        grip = extrude(regular(int(draw.choice([6, 8])), 2 * body * 1.08), second * 0.6, first + nut + 0.4 * second)
        solid = union(solid, grip)
    deep = min(deep, 0.4 * length)
    sockets = [
        place(drill(outer, deep, 0.0, 0.3 * wall), along="-z"),
        place(drill(outer, deep, 0.0, 0.3 * wall), (0, 0, length)),
    ]
    return Measured(difference(solid, *sockets, cylinder(inner, 3 * length, (0, 0, -length))), unit)


def pipe_plug(draw: np.random.Generator) -> Measured:
    """A tapered thread (1 in 16) with a square, hexagon, round or countersunk head."""
    outer, _ = _pipe(draw)
    run, high = outer * draw.uniform(1.2, 1.8), outer * draw.uniform(0.7, 1.1)
    unit, (outer, run, high) = in_units(run + high, outer, run, high)
    bevel, slope = 0.1 * outer, 1 / 32
    low = outer - run * slope
    stem = [(0.0, -run), (low - bevel, -run), (low + bevel * slope, bevel - run), (outer, 0.0)]
    cuts: list[Solid] = []
    match draw.choice(["square", "hexagon", "round", "sunk"]):
        case "square" | "hexagon" as form:
            sides = 4 if form == "square" else 6
            across = 2 * outer * (draw.uniform(0.62, 0.75) if sides == 4 else draw.uniform(1.02, 1.25))
            solid = union(turned([*stem, (0.0, 0.0)]), place(wrench_prism(sides, across, high + 0.1), (0, 0, -0.1)))
        case "round":
            solid = turned([*stem, (0.96 * outer, 0.05 * outer), (0.96 * outer, high), (0.0, high)])
        case _:
            solid = turned([*stem, (0.0, 0.0)])
            cuts.append(extrude(regular(int(draw.choice([4, 6])), outer * draw.uniform(0.8, 1.0)), run, -0.45 * run))
    if chance(draw, 0.5):
        cuts.append(place(drill(low * draw.uniform(0.55, 0.75), run * draw.uniform(0.3, 0.5), 0.0), (0, 0, -run), "-z"))
    return Measured(difference(solid, *cuts), unit)


def _tee(draw: np.random.Generator, branch: tuple[float, float], run: tuple[float, float]) -> Measured:
    """A run along x and a branch along z (outer and inner radii): plain ends, or sockets with bands."""
    (outer, inner), (out, bore) = run, branch
    half, high = outer * draw.uniform(1.6, 2.4), outer + out * draw.uniform(0.7, 1.3)
    unit, (outer, inner, out, bore, half, high) = in_units(2 * half, outer, inner, out, bore, half, high)
    solid = union(cylinder(outer, 2 * half, (-half, 0, 0), "x"), cylinder(out, high))
    cuts: list[Solid] = [cylinder(inner, 3 * half, (-1.5 * half, 0, 0), "x"), cylinder(bore, 2 * high)]
    if chance(draw, 0.6):
        band, lip = outer * draw.uniform(0.25, 0.5), outer * draw.uniform(0.08, 0.2)
        for x in (-half, half - band):
            solid = union(solid, cylinder(outer + lip, band, (x, 0, 0), "x"))
        solid = union(solid, cylinder(out + lip, band, (0, 0, high - band)))
        if chance(draw, 0.7):
            deep = min(outer * 0.6, 0.8 * (half - out))
            cuts += [cylinder((outer + inner) / 2 + lip / 2, deep + 1, (half - deep, 0, 0), "x")]
            cuts += [cylinder((outer + inner) / 2 + lip / 2, deep + 1, (-half - 1, 0, 0), "x")]
            cuts += [
                cylinder((out + bore) / 2 + lip / 2, 0.7 * (high - outer) + 1, (0, 0, high - 0.7 * (high - outer)))
            ]
    return Measured(difference(solid, *cuts), unit)


def pipe_tee(draw: np.random.Generator) -> Measured:
    """A straight tee; its branch is a hair thinner than its run, so that the pipes do not touch along a line."""
    outer, inner = _pipe(draw, 2)
    return _tee(draw, (0.98 * outer, 0.97 * inner), (outer, inner))


def reducing_tee(draw: np.random.Generator) -> Measured:
    """A tee with a thinner branch."""
    outer, inner = _pipe(draw, 3)
    return _tee(draw, _step_down(draw, outer, share=0.85), (outer, inner))


def valve_housing(draw: np.random.Generator) -> Measured:
    """The body of a globe or gate valve: a ball or a barrel on a flanged pipe, with a bonnet flange on top."""
    outer, inner = _pipe(draw, 4)
    half = outer * draw.uniform(2.4, 3.4)
    unit, (outer, inner, half) = in_units(2 * half, outer, inner, half)
    rim, thick = outer * draw.uniform(1.7, 2.0), outer * draw.uniform(0.22, 0.35)
    chest, top = outer * draw.uniform(1.3, 1.6), outer * draw.uniform(2.0, 2.6)
    solid = union(cylinder(outer, 2 * half, (-half, 0, 0), "x"), cylinder(0.9 * chest, top))
    solid = union(solid, sphere(chest) if chance(draw, 0.5) else cylinder(chest, 2.2 * outer, (0, 0, -1.1 * outer)))
    for x in (-half, half - thick):
        solid = union(solid, cylinder(rim, thick, (x, 0, 0), "x"))
    count = int(draw.choice([4, 6, 8]))
    bonnet = chest * draw.uniform(1.25, 1.45)
    plate = disc(bonnet) if chance(draw, 0.6) else regular(count, 2 * bonnet)
    solid = union(solid, extrude(plate, thick, top - thick))
    hole = cylinder(0.14 * outer, 2 * thick, ((rim + outer) / 2, 0, half - 1.5 * thick))
    cuts: list[Solid] = [place(bolt, along=a) for a in ("x", "-x") for bolt in ring(hole, count, np.pi / count)]
    cuts += ring(cylinder(0.1 * outer, 2 * thick, ((bonnet + 0.9 * chest) / 2, 0, top - 1.5 * thick)), count)
    cuts += [cylinder(inner, 3 * half, (-1.5 * half, 0, 0), "x"), cylinder(0.7 * chest, 2 * top, (0, 0, 0))]
    return Measured(difference(solid, *cuts), unit)
