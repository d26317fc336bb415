"""Training families around an axis: shafts, collars, flanges, pulleys, bushings, nozzles, ball studs, caps.

A family is a function of a random generator that gives a solid about 2 units long; every proportion is drawn, so that
no two parts are alike.
"""

from collections.abc import Sequence

import numpy as np

from jprimfit.data.shapes import (
    Profile,
    Real,
    box,
    cylinder,
    disc,
    drill,
    extrude,
    place,
    polygon,
    regular,
    revolve,
    ring,
    rotate,
    sphere,
)
from jprimfit.data.shapes import cone as frustum
from jprimfit.data.solids import Solid, difference, union


def chance(draw: np.random.Generator, probability: float) -> bool:
    """True with this probability."""
    return bool(draw.random() < probability)


def domed(points: Sequence[Sequence[Real]], bottom: Real, top: Real) -> Solid:
    """The solid of revolution of an outline from low to high, closed by balls of these radii (0 = by planes).

    A ball as large as its end makes a half ball that continues a cylinder smoothly.
    """
    outline, sweeps = list(points), [0.0] * len(points)
    for ball, row, side in ((bottom, 0, -1), (top, len(points) - 1, 1)):
        radius, height = points[row]
        rise = ball - float(np.sqrt(ball**2 - radius**2)) if ball else 0.0
        sweep = float(np.arcsin(radius / ball)) if ball else 0.0
        if side < 0:
            outline.insert(0, (0.0, height - rise))
            sweeps.insert(0, sweep)
        else:
            sweeps[-1] = sweep
            outline.append((0.0, height + rise))
            sweeps.append(0.0)
    return revolve(Profile(np.array(outline), np.array(sweeps)))


def drill_end(draw: np.random.Generator) -> float:
    """The end of a blind hole, for shapes.drill: a cone of 118 degrees, a half ball, or flat."""
    return float(draw.choice([1.03, -1.0, 0.0], p=[0.55, 0.3, 0.15]))


def turned(points: Sequence[Sequence[Real]], radius: Real | Sequence[Real] = 0.0) -> Solid:
    """The solid of revolution of a polygon (radius, z); radius as in shapes.polygon."""
    return revolve(polygon(points, radius))


def stepped_shaft(draw: np.random.Generator) -> Solid:
    """A shaft of two to five steps with chamfers, grooves, keyways, flats and centre holes."""
    count = int(draw.integers(2, 6))
    lengths = draw.dirichlet(np.full(count, 3.0)) * 2
    radii = draw.uniform(0.12, 0.45) * draw.uniform(0.45, 1.0, count)
    ends = np.cumsum(lengths)
    points, rounding = [(0.0, 0.0), (radii[0], 0.0)], [0.0, -draw.uniform(0.02, 0.06) if chance(draw, 0.7) else 0.0]
    for j in range(1, count):
        points += [(radii[j - 1], ends[j - 1]), (radii[j], ends[j - 1])]
        bevel = draw.uniform(0.015, 0.035) if chance(draw, 0.3) else 0.0
        limit = abs(radii[j] - radii[j - 1]) * 0.7
        larger_first = radii[j - 1] > radii[j]
        rounding += [-min(bevel, limit) * larger_first, -min(bevel, limit) * (not larger_first)]
    points += [(radii[-1], ends[-1]), (0.0, ends[-1])]
    rounding += [-draw.uniform(0.02, 0.06) if chance(draw, 0.7) else 0.0, 0.0]
    solid, cuts = turned(points, rounding), []
    for j in range(count):
        start, radius, length = float(ends[j] - lengths[j]), float(radii[j]), float(lengths[j])
        kind = draw.choice(["plain", "groove", "keyway", "flat", "bore"], p=[0.4, 0.22, 0.14, 0.14, 0.1])
        if length < 0.25 or kind == "plain":
            continue
        middle = start + length * draw.uniform(0.4, 0.6)
        if kind == "groove":
            depth, width = radius * draw.uniform(0.1, 0.25), draw.uniform(0.05, 0.12)
            hoop = [(radius - depth, 0.0), (1.0, 0.0), (1.0, width), (radius - depth, width)]
            cuts.append(place(turned(hoop), (0, 0, middle - width / 2)))
        elif kind == "keyway":
            width, span = radius * draw.uniform(0.4, 0.6), length * 0.6
            profile = polygon(
                [(-span / 2, -width / 2), (span / 2, -width / 2), (span / 2, width / 2), (-span / 2, width / 2)],
                width * 0.49,
            )
            slot = rotate(extrude(profile, 1.0, radius * draw.uniform(0.6, 0.8)), np.pi / 2, "y")
            cuts.append(place(slot, (0, 0, middle)))
        elif kind == "flat":
            sides = int(draw.integers(1, 3))
            depth = radius * draw.uniform(0.75, 0.92)
            block = box((1, 2, length * 0.5), (depth + 0.5, 0, middle))
            cuts += ring(block, sides)
        else:
            cuts.append(cylinder(radius * draw.uniform(0.25, 0.5), 2, (-1, 0, middle), "x"))
    if chance(draw, 0.4):
        hole = drill(float(radii[-1]) * draw.uniform(0.3, 0.6), draw.uniform(0.1, 0.3), drill_end(draw))
        cuts.append(place(hole, (0, 0, 2.0)))
    if chance(draw, 0.25):
        size = float(radii[0])
        ball = size * draw.uniform(1.0, 1.8)
        solid = union(solid, sphere(ball, (0, 0, float(np.sqrt(ball**2 - (0.9 * size) ** 2)))))
    return difference(solid, *cuts)


def collar(draw: np.random.Generator) -> Solid:
    """Washers, rings and collars: flat or tall, chamfered, split, with radial screw holes."""
    inner, height = draw.uniform(0.3, 0.85), draw.uniform(0.08, 0.9)
    limit = min(1 - inner, height)
    bevels = [-limit * draw.uniform(0.08, 0.25) if chance(draw, 0.6) else 0.0 for _ in range(2)]
    corners = [(inner, 0.0), (1.0, 0.0), (1.0, height), (inner, height)]
    solid = turned(corners, [bevels[0], bevels[1], bevels[1], bevels[0]])
    cuts = []
    if chance(draw, 0.35):
        cuts.append(box((2, draw.uniform(0.05, 0.25), 4), (1, 0, 0)))
    if height > 0.3:
        count = int(draw.integers(0, 4))
        hole = cylinder(height * draw.uniform(0.12, 0.3), 2, (0, 0, height / 2), "y")
        cuts += ring(hole, count, draw.uniform(0, 1)) if count else []
    if chance(draw, 0.3):
        step = turned(
            [(0.0, height * draw.uniform(0.4, 0.7)), (inner + (1 - inner) * 0.5, height * 0.7)]
            + [(inner + (1 - inner) * 0.5, height + 1), (0.0, height + 1)]
        )
        cuts.append(step)
    return difference(solid, *cuts)


def flange(draw: np.random.Generator) -> Solid:
    """A flange with a bolt circle, a straight or tapered hub, a bore and perhaps a raised face."""
    plate, hub, height = draw.uniform(0.12, 0.35), draw.uniform(0.35, 0.6), draw.uniform(0.3, 1.0)
    top = hub * draw.uniform(0.6, 0.95) if chance(draw, 0.5) else hub
    bore = min(top, hub) * draw.uniform(0.4, 0.8)
    points = [(bore, 0.0), (1.0, 0.0), (1.0, plate), (hub, plate), (top, plate + height), (bore, plate + height)]
    rounding = [
        0.0,
        -0.03 * chance(draw, 0.5),
        -draw.uniform(0.02, 0.05) * chance(draw, 0.6),
        0.04 * chance(draw, 0.2),
        0.0,
        -0.03 * chance(draw, 0.5),
    ]
    solid = turned(points, rounding)
    if chance(draw, 0.3):
        solid = union(solid, turned([(bore, -0.04), (hub * 1.1, -0.04), (hub * 1.1, 0.05), (bore, 0.05)]))
    count = int(draw.integers(3, 9))
    circle = (1 + hub) / 2
    size = min((1 - hub) * 0.3, circle * 0.5 * np.pi / count) * draw.uniform(0.6, 1.0)
    sunk = size * 0.35 if chance(draw, 0.3) else 0.0
    hole = place(drill(size, 1.0, 0.0, sunk), (circle, 0, plate))
    cuts = ring(hole, count, draw.uniform(0, np.pi / count))
    if chance(draw, 0.2):
        cuts.append(box((4, 4, 4), (0, circle + size * 1.5 + 2, 0)))
    return difference(solid, *cuts)


def pulley(draw: np.random.Generator) -> Solid:
    """A wheel: rim with a belt groove, web with holes or spokes, hub with a bore and a keyway."""
    width, rim, hub = draw.uniform(0.25, 0.6), draw.uniform(0.65, 0.8), draw.uniform(0.25, 0.4)
    web = width * draw.uniform(0.25, 0.6)
    long = width * draw.uniform(1.0, 1.6)
    groove, mouth = (1 - rim) * draw.uniform(0.3, 0.6), width * draw.uniform(0.3, 0.7)
    foot = mouth * draw.uniform(0.2, 1.0)
    right = [
        (1.0, -width / 2),
        (1.0, -mouth / 2),
        (1 - groove, -foot / 2),
        (1 - groove, foot / 2),
        (1.0, mouth / 2),
        (1.0, width / 2),
    ]
    bore = hub * draw.uniform(0.35, 0.65)
    left = [(rim, width / 2), (rim, web / 2), (hub, web / 2), (hub, long / 2), (bore, long / 2)]
    solid = turned(right + left + [(r, -z) for r, z in reversed(left)])
    cuts = []
    if chance(draw, 0.6):
        count = int(draw.integers(3, 8))
        middle = (rim + hub) / 2
        size = min((rim - hub) * 0.35, middle * 2.2 / count) * draw.uniform(0.6, 1.0)
        cuts += ring(cylinder(size, 2, (middle, 0, -1)), count)
    if chance(draw, 0.4):
        cuts.append(box((bore * 1.35, bore * 0.5, 3), (bore * 0.675, 0, 0)))
    if chance(draw, 0.3):
        cuts.append(cylinder(min(0.08, long * 0.2), hub * 1.5, (0, 0, 0), "x"))
    return difference(solid, *cuts)


def bushing(draw: np.random.Generator) -> Solid:
    """A pipe or sleeve, thin or thick, with collars, inner steps, cross holes and slots."""
    outer, length = draw.uniform(0.2, 0.7), 2.0
    inner = outer * draw.uniform(0.5, 0.93)
    bevel = (outer - inner) * draw.uniform(0.15, 0.4)
    corners = [(inner, 0.0), (outer, 0.0), (outer, length), (inner, length)]
    solid = turned(corners, [-bevel * chance(draw, 0.4) for _ in range(4)])
    for low in (0.0, draw.uniform(0.4, 1.8)):
        if chance(draw, 0.6):
            wide, thick = outer * draw.uniform(1.15, 1.7), draw.uniform(0.08, 0.25)
            rounding = [0.0, -thick * 0.2 * chance(draw, 0.5), -thick * 0.2 * chance(draw, 0.5), 0.0]
            inside = (inner + outer) / 2
            solid = union(
                solid,
                place(turned([(inside, 0.0), (wide, 0.0), (wide, thick), (inside, thick)], rounding), (0, 0, low)),
            )
    cuts = []
    if chance(draw, 0.4):
        deep = inner + (outer - inner) * draw.uniform(0.3, 0.6)
        depth = draw.uniform(0.2, 0.8)
        taper = inner + (deep - inner) * draw.uniform(0.0, 0.6) if chance(draw, 0.4) else deep
        cuts.append(
            turned([(0.0, length - depth), (taper, length - depth), (deep, length + 0.01), (0.0, length + 0.01)])
        )
    if chance(draw, 0.5):
        cuts.append(
            cylinder(
                outer * draw.uniform(0.15, 0.5), 4, (-2 * chance(draw, 0.6), 0, length * draw.uniform(0.3, 0.7)), "x"
            )
        )
    if chance(draw, 0.25):
        cuts.append(box((4, outer * draw.uniform(0.2, 0.6), length * draw.uniform(0.2, 0.5)), (0, 0, length)))
    return difference(solid, *cuts)


def nozzle(draw: np.random.Generator) -> Solid:
    """Funnels, nozzles and reducers: a thin wall over cylinders and cones, with or without a foot."""
    count = int(draw.integers(2, 5))
    heights = np.concatenate([[0.0], np.cumsum(draw.dirichlet(np.full(count, 3.0)) * 2)])
    radii = draw.uniform(0.15, 0.8, count + 1)
    for j in range(count):
        if chance(draw, 0.35):
            radii[j + 1] = radii[j]
    wall = draw.uniform(0.04, 0.1) if chance(draw, 0.6) else 0.0
    outer = list(zip(radii.tolist(), heights.tolist(), strict=True))
    inner = [(max(r - wall, 0.02), z) for r, z in outer] if wall else [(0.0, 0.0), (0.0, 2.0)]
    solid = turned(outer + inner[::-1])
    if chance(draw, 0.5):
        foot, thick = float(radii[0]) + draw.uniform(0.1, 0.35), draw.uniform(0.06, 0.2)
        base = turned(
            [(inner[0][0] + wall / 2, 0.0), (foot, 0.0), (foot, thick), (inner[0][0] + wall / 2, thick)]
            if wall
            else [(0.0, 0.0), (foot, 0.0), (foot, thick), (0.0, thick)]
        )
        solid = union(solid, base)
        if chance(draw, 0.6):
            size = (foot - float(radii[0])) * 0.3
            solid = difference(solid, *ring(cylinder(size, 4, (foot - 1.5 * size, 0, -2)), int(draw.integers(2, 7))))
    if chance(draw, 0.3):
        solid = difference(solid, box((4, 4, 4), (2 + draw.uniform(0, 0.3), 0, 0)))
    return solid


def ball_stud(draw: np.random.Generator) -> Solid:
    """Pins with a ball or a half ball at an end, a cylindrical or conical shank, a hexagon or a collar between."""
    ball, neck, shank = draw.uniform(0.2, 0.45), draw.uniform(0.1, 0.18), draw.uniform(0.12, 0.3)
    low = draw.uniform(0.7, 1.3)
    solid = union(sphere(ball, (0, 0, 2 - ball)), cylinder(neck, 2 - low - ball, (0, 0, low)))
    taper = shank * draw.uniform(0.6, 0.9) if chance(draw, 0.5) else shank
    bevel = -0.04 * chance(draw, 0.6)
    solid = union(solid, turned([(0.0, 0.0), (taper, 0.0), (shank, low), (0.0, low)], [0.0, bevel, 0.0, 0.0]))
    thick, wide = draw.uniform(0.1, 0.3), shank * draw.uniform(1.2, 1.8)
    if chance(draw, 0.7):
        solid = union(solid, extrude(regular(6, 2 * wide) if chance(draw, 0.5) else disc(wide), thick, low - thick / 2))
    cuts = []
    if chance(draw, 0.5):
        cuts.append(box((2, 2, 1), (0, 0, 2 - ball * draw.uniform(0.1, 0.5) + 0.5)))
    if chance(draw, 0.3):
        cuts.append(cylinder(ball * draw.uniform(0.2, 0.45), 2, (-1, 0, 2 - ball), "x"))
    if chance(draw, 0.3):
        cuts.append(cylinder(shank * draw.uniform(0.2, 0.4), 2, (-1, 0, low * 0.4), "x"))
    return difference(solid, *cuts)


def dome_cap(draw: np.random.Generator) -> Solid:
    """Caps and bowls: a wall closed by a part of a sphere, solid or hollow, with a rim, holes and a flat or a stud."""
    radius, wall = draw.uniform(0.5, 1.0), draw.uniform(0.06, 0.2)
    height, ball = draw.uniform(0.1, 0.9), radius * draw.uniform(1.0, 1.5)
    drop = float(np.sqrt(ball**2 - radius**2))
    solid = domed([(radius, 0.0), (radius, height)], 0.0, ball)
    if chance(draw, 0.7):
        inside = radius - wall
        shift = float(np.sqrt((ball - wall) ** 2 - inside**2)) - drop
        solid = difference(solid, domed([(inside, -1.0), (inside, height + shift)], 0.0, ball - wall))
    if chance(draw, 0.6):
        wide, thick = radius * draw.uniform(1.15, 1.5), draw.uniform(0.08, 0.25)
        middle = radius - wall / 2
        solid = union(
            solid, turned([(middle, 0.0), (wide, 0.0), (wide, thick), (middle, thick)], [0.0, -thick * 0.25, 0.0, 0.0])
        )
        if chance(draw, 0.6):
            size = (wide - radius) * 0.3
            solid = difference(solid, *ring(cylinder(size, 4, ((radius + wide) / 2, 0, -2)), int(draw.integers(3, 9))))
    peak = height - drop + ball
    if chance(draw, 0.4):
        solid = difference(solid, cylinder(radius * draw.uniform(0.15, 0.4), 4, (0, 0, 0)))
    elif chance(draw, 0.5):
        foot = frustum(
            radius * 0.3, radius * draw.uniform(0.15, 0.3), draw.uniform(0.2, 0.5) + wall, (0, 0, peak - wall * 0.9)
        )
        solid = union(solid, foot)
    return solid


def round_pin(draw: np.random.Generator) -> Solid:
    """Pins and rollers with half-ball or shallow domed ends, ball collars, tapered or stepped between."""
    first = draw.uniform(0.15, 0.5)
    second = first * draw.uniform(0.6, 1.0) if chance(draw, 0.5) else first
    low, high = first * draw.uniform(0.9, 1.2), 2 - second * draw.uniform(0.9, 1.2)
    outline = [(first, low), (second, high)]
    if second < first and chance(draw, 0.5):
        middle = draw.uniform(0.4, 0.6) * (low + high)
        outline[1:1] = [(first, middle), (second, middle)]
    balls = [size * draw.choice([0.0, 1.0, draw.uniform(1.05, 1.6)], p=[0.15, 0.45, 0.4]) for size in (first, second)]
    solid = domed(outline, *balls)
    if chance(draw, 0.5):
        solid = union(solid, sphere(first * draw.uniform(1.15, 1.5), (0, 0, draw.uniform(0.7, 1.3))))
    cuts: list[Solid] = []
    if chance(draw, 0.5):
        height = draw.uniform(low, high)
        cuts.append(cylinder(second * draw.uniform(0.2, 0.5), 4, (-2, 0, height), "x"))
    if chance(draw, 0.4):
        cuts += ring(box((1, 4, draw.uniform(0.2, 0.5)), (second * 0.85 + 0.5, 0, 1.0)), int(draw.integers(1, 3)))
    return difference(solid, *cuts)
