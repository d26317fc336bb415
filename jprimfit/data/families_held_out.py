"""Families that no network is trained on: for validation (first four) and for the test set (the rest).

A family is a function of a random generator that gives a solid about 2 units long; see families_turned.
"""

import numpy as np

from jprimfit.data.families_turned import chance, turned
from jprimfit.data.shapes import (
    box,
    cylinder,
    disc,
    drill,
    extrude,
    place,
    polygon,
    rectangle,
    regular,
    ring,
    rotate,
    sphere,
    stadium,
)
from jprimfit.data.shapes import cone as frustum
from jprimfit.data.solids import Solid, difference, intersection, union


def clevis(draw: np.random.Generator) -> Solid:
    """A fork with round ends and a pin hole, on a shank."""
    wide, long, gap = draw.uniform(0.5, 0.9), draw.uniform(0.7, 1.1), draw.uniform(0.2, 0.45)
    radius = wide / 2
    arms = union(box((wide, wide, long), (0, 0, long / 2)), cylinder(radius, wide, (0, -wide / 2, long), "y"))
    shank = radius * draw.uniform(0.5, 0.9)
    rod = turned([(0.0, -0.9), (shank, -0.9), (shank, 0.05), (0.0, 0.05)], [0.0, -0.05, 0.0, 0.0])
    floor = draw.uniform(0.15, 0.3)
    cuts: list[Solid] = [
        box((4, gap, 4), (0, 0, 2 + floor)),
        cylinder(radius * draw.uniform(0.3, 0.6), 4, (0, -2, long), "y"),
    ]
    if chance(draw, 0.5):
        cuts.append(place(drill(shank * 0.5, 0.4, 1.03, 0.02), (0, 0, -0.9), "-z"))
    if chance(draw, 0.4):
        cuts += ring(box((1, 4, 0.4), (shank * 0.85 + 0.5, 0, -0.5)), 2)
    return difference(union(arms, rod), *cuts)


def pillow_block(draw: np.random.Generator) -> Solid:
    """A bearing housing: a half-round body with a bore on a foot with two slots or holes."""
    radius, deep, foot = draw.uniform(0.4, 0.6), draw.uniform(0.3, 0.7), draw.uniform(0.12, 0.25)
    high = radius * draw.uniform(0.9, 1.2) + foot
    housing = union(box((2 * radius, deep, high), (0, 0, high / 2)), cylinder(radius, deep, (0, -deep / 2, high), "y"))
    base = rotate(
        extrude(rectangle(2, foot, foot * 0.4 * chance(draw, 0.5), (0, foot / 2)), deep, -deep / 2), np.pi / 2, "x"
    )
    bore = radius * draw.uniform(0.45, 0.75)
    cuts: list[Solid] = [cylinder(bore, 4, (0, -2, high), "y")]
    if chance(draw, 0.5):
        cuts.append(cylinder((bore + radius) / 2, 4, (0, deep * 0.25, high), "y"))
    x, size = (1 + radius) / 2, min((1 - radius) * 0.25, deep * 0.25)
    slot = (
        extrude(stadium(size, size * 0.8), 4, -1) if chance(draw, 0.5) else place(drill(size, 1, 0, 0.03), (0, 0, foot))
    )
    cuts += [place(slot, (x, 0, 0)), place(slot, (-x, 0, 0))]
    if chance(draw, 0.5):
        cuts.append(cylinder(size * 0.5, 4, (0, 0, high)))
    return difference(union(housing, base), *cuts)


def slotted_profile(draw: np.random.Generator) -> Solid:
    """A length of square extrusion with a T-slot in every side and a centre bore."""
    side, long = draw.uniform(0.6, 1.2), 2.0
    solid: Solid = extrude(rectangle(side, side, side * 0.06 * chance(draw, 0.7)), long)
    mouth, wide, lip = side * draw.uniform(0.14, 0.24), side * draw.uniform(0.35, 0.5), side * draw.uniform(0.07, 0.12)
    deep, half = lip + side * draw.uniform(0.08, 0.13), side / 2
    tee = polygon(
        [(half + 1, -mouth / 2), (half + 1, mouth / 2), (half - lip, mouth / 2), (half - lip, wide / 2)]
        + [(half - deep, wide * draw.uniform(0.4, 0.5)), (half - deep, -wide * 0.45), (half - lip, -wide / 2)]
        + [(half - lip, -mouth / 2)]
    )
    slots = ring(extrude(tee, 6, -2), int(draw.choice([2, 4])))
    return difference(solid, *slots, cylinder(side * draw.uniform(0.06, 0.12), 6, (0, 0, -2)))


def taper_plug(draw: np.random.Generator) -> Solid:
    """A conical plug with a square or hexagonal drive, a collar and a drilled or domed end."""
    low, high, tall = draw.uniform(0.3, 0.6), draw.uniform(0.65, 0.9), draw.uniform(0.8, 1.4)
    solid: Solid = frustum(low, high, tall)
    thick = draw.uniform(0.1, 0.3)
    solid = union(
        solid,
        turned(
            [(0.0, tall - 0.05), (1.0, tall - 0.05), (1.0, tall + thick), (0.0, tall + thick)], [0, -0.04, -0.04, 0]
        ),
    )
    drive = high * draw.uniform(0.6, 0.9)
    cuts: list[Solid] = []
    if chance(draw, 0.5):
        solid = union(solid, extrude(regular(int(draw.choice([4, 6])), drive), draw.uniform(0.2, 0.5) + thick, tall))
    else:
        cuts.append(extrude(regular(int(draw.choice([4, 6])), drive), 2, tall + thick - draw.uniform(0.2, 0.5)))
    if chance(draw, 0.5):
        cuts.append(place(drill(low * draw.uniform(0.4, 0.7), 0.4, 1.03), (0, 0, 0), "-z"))
    else:
        ball = low * draw.uniform(1.05, 1.6)
        solid = union(solid, sphere(ball, (0, 0, float(np.sqrt(ball**2 - (low * 0.97) ** 2)))))
    if chance(draw, 0.4):
        cuts.append(cylinder(low * 0.35, 4, (-2, 0, tall * 0.5), "x"))
    return difference(solid, *cuts)


def _shank(draw: np.random.Generator, radius: float, length: float) -> Solid:
    """A shank that hangs from z = 0: a thinner threaded part, an undercut, a point, at random."""
    thread = length * draw.uniform(0.4, 0.8)
    core = radius * draw.uniform(0.82, 0.95) if chance(draw, 0.6) else radius
    point = draw.uniform(0.03, 0.1)
    points = [(0.0, 0.1), (radius, 0.1), (radius, -length + thread)]
    points += [(core, -length + thread)] if core < radius else []
    points += [(core, -length + point), (core - point * draw.uniform(0.5, 1.0), -length), (0.0, -length)]
    return turned(points)


def hex_bolt(draw: np.random.Generator) -> Solid:
    """A bolt with a chamfered hexagon head, with or without a washer face."""
    head, radius = draw.uniform(0.25, 0.5), draw.uniform(0.25, 0.4)
    flats = radius * draw.uniform(2.8, 3.6)
    corner = flats / np.sqrt(3)
    bevel = (corner - flats / 2) * draw.uniform(1.1, 1.4)
    fall = bevel * draw.uniform(0.4, 0.7)
    cap = turned(
        [
            (0.0, -0.5),
            (corner + 0.05, -0.5),
            (corner + 0.05, head - fall * (1 + 0.05 / bevel)),
            (corner - bevel, head),
            (0.0, head),
        ]
    )
    solid = union(intersection(extrude(regular(6, flats), head), cap), _shank(draw, radius, 2 - head))
    if chance(draw, 0.5):
        solid = union(solid, cylinder(flats / 2 * draw.uniform(0.92, 1.5), 0.09, (0, 0, -0.06)))
    return solid


def socket_screw(draw: np.random.Generator) -> Solid:
    """A cylindrical, button or countersunk head with a hexagonal or square socket."""
    radius, head = draw.uniform(0.2, 0.35), draw.uniform(0.25, 0.5)
    wide = radius * draw.uniform(1.45, 1.9)
    match draw.choice(["cylinder", "countersunk", "button"]):
        case "cylinder":
            solid = turned([(0.0, 0.0), (wide, 0.0), (wide, head), (0.0, head)], [0, 0, -0.04, 0])
        case "countersunk":
            solid = turned([(0.0, 0.0), (radius, 0.0), (wide, head * 0.8), (wide, head), (0.0, head)])
        case _:
            ball = (head**2 + wide**2) / (2 * head) if head < wide else wide
            solid = intersection(sphere(ball, (0, 0, head - ball)), cylinder(wide * 1.1, head - 0.001, (0, 0, 0.001)))
    solid = union(solid, _shank(draw, radius, 2 - head))
    sides, depth = int(draw.choice([6, 6, 4])), head * draw.uniform(0.4, 0.7)
    flats = wide * draw.uniform(0.6, 0.85)
    tip = extrude(regular(sides, flats), 1, head - depth)
    return difference(solid, union(tip, frustum(0.0, flats * 0.5, flats * 0.25, (0, 0, head - depth - flats * 0.249))))


def tee_fitting(draw: np.random.Generator) -> Solid:
    """A pipe with a branch, hollow, with reinforced or flanged ends."""
    run, branch = draw.uniform(0.3, 0.45), draw.uniform(0.6, 1.0)
    out = run * draw.uniform(0.5, 1.0)
    wall = run * draw.uniform(0.15, 0.35)
    height = run + draw.uniform(0.3, 0.7)
    out = min(out, run * 0.98)
    solid = union(cylinder(run, 2, (-1, 0, 0), "x"), cylinder(out, height))
    lip, long = draw.uniform(0.06, 0.15), draw.uniform(0.1, 0.25)
    if chance(draw, 0.7):
        for x in (-1.0, 1.0 - long):
            solid = union(solid, cylinder(run + lip, long, (x, 0, 0), "x"))
        solid = union(solid, cylinder(out + lip, long, (0, 0, height - long)))
    elif chance(draw, 0.5):
        solid = union(solid, sphere(run * 1.15))
    bore = out - wall * out / run
    return difference(solid, cylinder(run - wall, 4, (-2 if branch > 0.7 else -0.8, 0, 0), "x"), cylinder(bore, 4))


def knob(draw: np.random.Generator) -> Solid:
    """A handle: a head with scallops or a ball, a neck, a foot with a bore and a cross pin hole."""
    head, thick, foot = draw.uniform(0.7, 1.0), draw.uniform(0.4, 0.7), draw.uniform(0.3, 0.5)
    tall = 1.6
    neck = foot * draw.uniform(0.6, 1.0)
    stem = turned(
        [(0.0, 0.0), (foot, 0.0), (foot, 0.3), (neck, draw.uniform(0.4, 0.7)), (neck, tall), (0.0, tall)],
        [0, -0.03, 0, 0, 0, 0],
    )
    cuts: list[Solid] = [place(drill(foot * draw.uniform(0.4, 0.7), draw.uniform(0.3, 0.7), 1.03), (0, 0, 0), "-z")]
    if chance(draw, 0.6):
        top: Solid = turned([(0.0, 0.0), (head, 0.0), (head, thick), (0.0, thick)], [0, -0.06, -0.06, 0])
        count = int(draw.integers(3, 8))
        size = head * np.pi / count * draw.uniform(0.4, 0.6)
        top = difference(top, *ring(cylinder(size, 4, (head + size * draw.uniform(0.1, 0.5), 0, -2)), count))
        solid = union(stem, place(top, (0, 0, tall - 0.1)))
    else:
        solid = union(stem, sphere(head * 0.65, (0, 0, tall)))
        if chance(draw, 0.5):
            cuts.append(box((4, 4, 1), (0, 0, tall + head * draw.uniform(0.3, 0.55) + 0.5)))
    if chance(draw, 0.5):
        cuts.append(cylinder(0.06, 4, (-2, 0, 0.15), "x"))
    return difference(solid, *cuts)


def stud_plate(draw: np.random.Generator) -> Solid:
    """A hollow brick or a base with rows of round studs."""
    across, along = int(draw.integers(1, 4)), int(draw.integers(2, 5))
    pitch = 2 / along
    tall, stud = pitch * draw.uniform(0.4, 1.2), pitch * draw.uniform(0.25, 0.36)
    solid: Solid = box((2, pitch * across, tall), (0, 0, tall / 2))
    spots = [(-1 + pitch * (i + 0.5), pitch * (j + 0.5 - across / 2)) for i in range(along) for j in range(across)]
    rise = pitch * draw.uniform(0.15, 0.4)
    taper = stud * draw.choice([1.0, 1.0, 0.8])
    solid = union(solid, *(frustum(stud, taper, rise + 0.05, (x, y, tall - 0.05)) for x, y in spots))
    wall = pitch * draw.uniform(0.12, 0.2)
    if chance(draw, 0.5):
        solid = difference(solid, box((2 - 2 * wall, pitch * across - 2 * wall, tall * 1.4), (0, 0, 0)))
    elif chance(draw, 0.5):
        solid = difference(solid, *(cylinder(stud * 0.5, 4, (x, y, tall)) for x, y in spots[:2]))
    return solid


def v_block(draw: np.random.Generator) -> Solid:
    """A block with a V groove, a relief slot at its foot, side slots and clamp holes."""
    width, height, deep = draw.uniform(0.8, 1.4), draw.uniform(0.7, 1.2), draw.uniform(0.6, 2.0)
    half, mouth = draw.uniform(0.5, 0.9), min(width * 0.42, 0.6)
    fall = mouth / np.tan(half)
    fall = min(fall, height * 0.7)
    vee = polygon([(0.0, height - fall), (mouth * 1.5, height + fall * 0.5), (-mouth * 1.5, height + fall * 0.5)])
    body = extrude(rectangle(width, height, -0.05 * chance(draw, 0.5), (0, height / 2)), 2 * deep, -deep)
    relief = draw.uniform(0.06, 0.12)
    cuts: list[Solid] = [extrude(vee, 8, -4), box((relief, 2 * relief + 0.2, 8), (0, height - fall + 0.05, 0))]
    if chance(draw, 0.6):
        size = draw.uniform(0.1, 0.2)
        cuts += [box((0.3, size, 8), (side * width / 2, height * 0.4, 0)) for side in (-1, 1)]
    if chance(draw, 0.6):
        size = min(0.1, deep * 0.2)
        cuts += [cylinder(size, 4, (0, -2, z), "y") for z in (-deep * 0.6, deep * 0.6)]
    return rotate(difference(body, *cuts), np.pi / 2, "x")


def valve_body(draw: np.random.Generator) -> Solid:
    """A ball on a flanged pipe with a bonnet on top; bored through."""
    pipe, ball = draw.uniform(0.25, 0.35), draw.uniform(0.45, 0.6)
    wide, thick = pipe + draw.uniform(0.2, 0.35), draw.uniform(0.1, 0.2)
    solid: Solid = union(cylinder(pipe, 2, (-1, 0, 0), "x"), sphere(ball))
    for x in (-1.0, 1.0 - thick):
        solid = union(solid, cylinder(wide, thick, (x, 0, 0), "x"))
    neck, top = pipe * draw.uniform(0.7, 1.0), ball + draw.uniform(0.15, 0.4)
    solid = union(solid, cylinder(neck, top))
    drive = neck * draw.uniform(1.3, 1.7)
    solid = union(
        solid,
        extrude(regular(int(draw.choice([6, 8])), 2 * drive) if chance(draw, 0.6) else disc(drive), thick, top - thick),
    )
    cuts: list[Solid] = [
        cylinder(pipe * draw.uniform(0.6, 0.8), 4, (-2, 0, 0), "x"),
        cylinder(neck * draw.uniform(0.4, 0.7), 4),
    ]
    if chance(draw, 0.7):
        size = (wide - pipe) * 0.28
        hole = cylinder(size, thick * 1.4, ((wide + pipe) / 2, 0, 1 - thick * 1.2))
        for along in ("x", "-x"):
            cuts += [place(piece, along=along) for piece in ring(hole, int(draw.integers(3, 6)), draw.uniform(0, 1))]
    return difference(solid, *cuts)


def cross_yoke(draw: np.random.Generator) -> Solid:
    """The spider of a universal joint: four stepped pins on a hub."""
    pin, hub = draw.uniform(0.15, 0.25), draw.uniform(0.35, 0.5)
    solid: Solid = sphere(hub) if chance(draw, 0.4) else box((1.6 * hub, 1.6 * hub, 2 * pin * draw.uniform(1.1, 1.6)))
    end, bevel = pin * draw.uniform(0.6, 1.0), draw.uniform(0.02, 0.05)
    middle = draw.uniform(0.6, 0.8)
    points = [(0.0, 0.0), (pin, 0.0), (pin, middle)]
    points += [(end, middle)] if end < pin * 0.95 else []
    end = end if end < pin * 0.95 else pin
    arm = turned([*points, (end, 1 - bevel), (end - bevel, 1.0), (0.0, 1.0)])
    solid = union(solid, *ring(place(arm, along="x"), 4 if chance(draw, 0.8) else 3))
    cuts: list[Solid] = []
    if chance(draw, 0.6):
        cuts += ring(place(drill(end * 0.4, 0.3, 1.03), (1, 0, 0), "x"), 4)
    if chance(draw, 0.5):
        cuts.append(cylinder(hub * draw.uniform(0.25, 0.5), 4, (0, 0, -2)))
    return difference(solid, *cuts)


def mitre_elbow(draw: np.random.Generator) -> Solid:
    """Two pipes that meet at an angle, joined by a ball or a mitre, with flanges at the ends."""
    radius, angle = draw.uniform(0.25, 0.4), draw.uniform(0.7, 1.6)
    first, second = draw.uniform(0.9, 1.4), draw.uniform(0.9, 1.4)
    wide, thick = radius + draw.uniform(0.12, 0.3), draw.uniform(0.1, 0.2)

    def pipe(size: float, length: float) -> list[Solid]:
        return [cylinder(size, length), rotate(cylinder(size, length * second / first), angle, "x")]

    solid: Solid = union(*pipe(radius, first), sphere(radius * draw.uniform(1.0, 1.2) + 1e-4))
    flat = cylinder(wide, thick, (0, 0, first - thick))
    other = rotate(cylinder(wide, thick, (0, 0, second - thick)), angle, "x")
    solid = union(solid, flat, other) if chance(draw, 0.8) else solid
    bore = radius * draw.uniform(0.6, 0.85)
    cuts: list[Solid] = [*pipe(bore, first + 1), sphere(bore + 1e-4)]
    if chance(draw, 0.6):
        size = (wide - radius) * 0.3
        cuts += ring(cylinder(size, 2, ((wide + radius) / 2, 0, first - thick * 1.5)), int(draw.integers(3, 6)))
    return difference(solid, *cuts)


def crank(draw: np.random.Generator) -> Solid:
    """A crank: two webs with a pin between them and shaft ends."""
    throw, shaft, pin = draw.uniform(0.35, 0.6), draw.uniform(0.15, 0.25), draw.uniform(0.12, 0.22)
    thick, gap = draw.uniform(0.12, 0.22), draw.uniform(0.25, 0.5)
    outline = stadium(throw, max(shaft, pin) * draw.uniform(1.2, 1.5))
    web = place(extrude(outline, thick), (throw / 2, 0, 0))
    low = place(web, (0, 0, -gap / 2 - thick))
    solid: Solid = union(low, place(web, (0, 0, gap / 2)), cylinder(pin, gap + thick, (throw, 0, -(gap + thick) / 2)))
    for sign, along in ((1, "z"), (-1, "-z")):
        reach = draw.uniform(0.3, 0.6)
        end = turned([(0.0, 0.0), (shaft, 0.0), (shaft, reach), (0.0, reach)], [0, 0, -0.03 * chance(draw, 0.7), 0])
        solid = union(solid, place(end, (0, 0, sign * (gap / 2 + thick * 0.5)), along))
    if chance(draw, 0.5):
        return difference(solid, cylinder(shaft * 0.5, 4, (0, 0, gap / 2 + 0.01)))
    return solid


def slotted_screw(draw: np.random.Generator) -> Solid:
    """A short screw with a pan, oval or flat head and a slot or a cross."""
    radius, head = draw.uniform(0.25, 0.4), draw.uniform(0.2, 0.4)
    wide = radius * draw.uniform(1.6, 2.1)
    if chance(draw, 0.5):
        ball = (head**2 + wide**2) / (2 * head)
        solid: Solid = intersection(sphere(ball, (0, 0, head - ball)), cylinder(wide * 1.1, head, (0, 0, 0.0)))
    else:
        solid = turned([(0.0, 0.0), (radius, 0.0), (wide, head * 0.7), (wide, head), (0.0, head)])
    solid = union(solid, _shank(draw, radius, 2 - head))
    slot = box((4, wide * draw.uniform(0.15, 0.25), 1), (0, 0, head * draw.uniform(0.45, 0.65) + 0.5))
    return difference(solid, slot, rotate(slot, np.pi / 2)) if chance(draw, 0.3) else difference(solid, slot)
