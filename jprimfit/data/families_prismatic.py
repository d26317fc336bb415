"""Training families that are mostly plates and blocks: brackets, plates, nuts, blocks, levers, hinges, prisms.

A family is a function of a random generator that gives a solid about 2 units long; see families_turned.
"""

import numpy as np

from jprimfit.data.families_turned import chance, drill_end, turned
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
    tangent_hull,
)
from jprimfit.data.shapes import cone as frustum
from jprimfit.data.solids import Solid, difference, intersection, union


def bracket(draw: np.random.Generator) -> Solid:
    """An L or U of plates, rounded at the bend or not, with holes in both legs and perhaps a rib."""
    thick, depth, height = draw.uniform(0.08, 0.25), draw.uniform(0.5, 1.5), draw.uniform(0.6, 1.6)
    two = chance(draw, 0.4)
    points = [(-1.0, 0.0), (1.0, 0.0)]
    points += [(1.0, height), (1 - thick, height), (1 - thick, thick)] if two else [(1.0, thick)]
    points += [(-1 + thick, thick), (-1 + thick, height), (-1.0, height)]
    bend = draw.uniform(0.5, 1.0) * thick if chance(draw, 0.4) else 0.0
    rounding = (
        [2.0 * bend if chance(draw, 0.7) else bend, (2.0 * bend if two else 0.0)]
        + ([0.0, 0.0, bend] if two else [0.0])
        + [bend, 0.0, 0.0]
    )
    solid = place(extrude(polygon(points, rounding), depth, -depth / 2), (0, 0, 0), "x")  # x -> y, y -> z
    solid = rotate(solid, -np.pi / 2)
    cuts = []
    size = min(depth, 1.0) * draw.uniform(0.1, 0.22)
    for x in (0.3,) if chance(draw, 0.4) else (-0.2, 0.55):
        cuts.append(place(drill(size, 1.0, 0.0, size * 0.4 * chance(draw, 0.4)), (x, 0, thick)))
    row = [0.0] if chance(draw, 0.5) or depth < 0.9 else [-depth / 4, depth / 4]
    cuts += [cylinder(size * 0.9, 4, (-2, y, thick + (height - thick) * 0.6), "x") for y in row]
    if chance(draw, 0.35) and not two:
        run = min(height - thick, 1.0) * 0.7
        triangle = polygon([(thick / 2, thick / 2), (thick + run, thick / 2), (thick / 2, thick + run)])
        rib = rotate(extrude(triangle, thick * 0.7, -thick * 0.35), np.pi / 2, "x")
        side = depth / 2 - thick * 0.35 if row == [0.0] else 0.0
        solid = union(solid, place(rib, (-1, side, 0)))
    if chance(draw, 0.3):
        flat = extrude(rectangle(2.0, depth, min(0.3, depth * 0.3)), 4, -2)
        solid = intersection(solid, flat)
    return difference(solid, *cuts)


def drilled_plate(draw: np.random.Generator) -> Solid:
    """A plate with rounded or cut corners, through holes, countersinks, counterbores, blind holes and a pocket."""
    width, thick = draw.uniform(0.6, 2.0), draw.uniform(0.1, 0.4)
    corner = min(width, 2) * draw.uniform(0.05, 0.2) * draw.choice([-1.0, 0.0, 1.0])
    solid = extrude(rectangle(2.0, width, corner), thick, -thick)
    cuts = []
    size = width * draw.uniform(0.05, 0.1)
    x, y = 1 - 2.2 * size - abs(corner) * 0.3, width / 2 - 2.2 * size - abs(corner) * 0.3
    spots = [(x, y), (-x, y), (x, -y), (-x, -y)] if chance(draw, 0.6) else [(x, 0.0), (-x, 0.0)]
    style = draw.choice(["through", "countersink", "counterbore", "blind"])
    for a, b in spots:
        if style == "blind":
            cuts.append(
                place(
                    drill(
                        size,
                        thick * 0.5 if thick > 2 * size else thick * 0.2,
                        drill_end(draw) if thick > 2 * size else 0.0,
                    ),
                    (a, b, 0),
                )
            )
        else:
            cuts.append(place(drill(size, 1.0, 0.0, size * 0.5 * (style == "countersink")), (a, b, 0)))
        if style == "counterbore":
            cuts.append(cylinder(size * 1.6, 1, (a, b, -thick * 0.4)))
    middle = min(0.5 * width, 0.9) * draw.uniform(0.3, 0.7)
    match draw.choice(["none", "pocket", "bore", "slot", "boss"]):
        case "pocket":
            deep = thick * draw.uniform(0.3, 0.7)
            cuts.append(extrude(rectangle(middle * 2, middle * 1.4, middle * 0.25 * chance(draw, 0.7)), 1, -deep))
        case "bore":
            cuts.append(cylinder(middle, 2, (0, 0, -1)))
        case "slot":
            cuts.append(extrude(stadium(middle * 1.4, middle * 0.4), 2, -1))
        case "boss":
            solid = union(solid, cylinder(middle, draw.uniform(0.1, 0.5) + thick, (0, 0, -thick * 0.5)))
            cuts.append(place(drill(middle * 0.5, 0.3, drill_end(draw)), (0, 0, 0.6)))
            cuts.append(cylinder(middle * 0.5, 2, (0, 0, -thick * draw.uniform(0.1, 0.4))))
    return difference(solid, *cuts)


def hex_nut(draw: np.random.Generator) -> Solid:
    """Nuts and hexagonal or square rods: chamfer cones, a bore with countersinks, a collar, a slotted crown."""
    sides, height = int(draw.choice([4, 6, 6, 6, 8])), draw.uniform(0.4, 1.6)
    flats = 1.7
    corner = flats / 2 / np.cos(np.pi / sides)
    solid = extrude(regular(sides, flats), height)
    bevel = (corner - flats / 2) * draw.uniform(1.0, 1.6)
    fall = bevel * np.tan(draw.uniform(0.4, 0.9))
    rim = [
        (0.0, 0.0),
        (corner - bevel, 0.0),
        (corner + 0.02, fall * (1 + 0.02 / bevel)),
        (corner + 0.02, height - fall * (1 + 0.02 / bevel)),
        (corner - bevel, height),
        (0.0, height),
    ]
    if chance(draw, 0.5):
        rim = [(0.0, 0.0), (corner + 0.02, 0.0), *rim[3:]]
    if height > 2.5 * fall:
        solid = intersection(solid, turned(rim))
    bore = flats * draw.uniform(0.2, 0.36)
    if chance(draw, 0.4):
        wide, thick = corner * draw.uniform(1.0, 1.3), draw.uniform(0.08, 0.2)
        solid = union(
            solid, turned([(0.0, -thick), (wide, -thick), (wide, 0.0), (wide * 0.8, thick * 0.8), (0.0, thick * 0.8)])
        )
    cuts = []
    if chance(draw, 0.85):
        sunk = bore * 0.15 * chance(draw, 0.7)
        cuts.append(place(drill(bore, 3.0, 0.0, sunk), (0, 0, height)))
    if chance(draw, 0.25):
        cuts += ring(box((4, bore * 0.5, 0.5), (0, 0, height + 0.25 - height * 0.25)), sides // 2)
    return difference(solid, *cuts)


def stepped_block(draw: np.random.Generator) -> Solid:
    """A block with steps, slots, bevelled edges, a bearing bore and bosses."""
    width, height = draw.uniform(0.6, 1.6), draw.uniform(0.5, 1.4)
    count = int(draw.integers(1, 4))
    cut = np.sort(draw.uniform(-0.9, 0.9, count))
    levels = height * draw.uniform(0.3, 1.0, count + 1)
    points = [(-1.0, 0.0), (1.0, 0.0), (1.0, levels[-1])]
    for j in range(count - 1, -1, -1):
        points += [(cut[j], levels[j + 1]), (cut[j] - draw.uniform(0.0, 0.2) * chance(draw, 0.3), levels[j])]
    points.append((-1.0, levels[0]))
    if chance(draw, 0.5):
        points[1:2] = [(1 - 0.2, 0.0), (1.0, 0.12)]
    solid = rotate(extrude(polygon(points), width, -width / 2), np.pi / 2, "x")
    cuts = []
    for _ in range(int(draw.integers(1, 4))):
        size = width * draw.uniform(0.08, 0.22)
        x = draw.uniform(-0.8, 0.8)
        match draw.choice(["vertical", "cross", "blind", "slot", "end"]):
            case "vertical":
                cuts.append(cylinder(size, 4, (x, draw.uniform(-0.2, 0.2) * width, -2)))
            case "cross":
                low = float(np.min(levels))
                cuts.append(cylinder(min(size, low * 0.35), 4, (x, -2, low * 0.5), "y"))
            case "blind":
                top = levels[int(np.searchsorted(cut, x))]
                cuts.append(place(drill(size, top * 0.5, drill_end(draw)), (x, 0, top)))
            case "slot":
                cuts.append(box((draw.uniform(0.1, 0.35), 4, 2), (x, 0, height * draw.uniform(0.15, 0.3) + 1)))
            case "end":
                cuts.append(
                    place(
                        drill(min(size, levels[0] * 0.3), draw.uniform(0.2, 0.6), drill_end(draw)),
                        (-1, 0, levels[0] / 2),
                        "-x",
                    )
                )
    return difference(solid, *cuts)


def lever(draw: np.random.Generator) -> Solid:
    """Two bosses of different size joined by a tangent or straight web, with bores, keyways and a flat."""
    first, second = draw.uniform(0.25, 0.5), draw.uniform(0.15, 0.35)
    reach = 2 - first - second
    thick = draw.uniform(0.12, 0.35)
    if chance(draw, 0.6):
        inset = draw.uniform(0.75, 1.0)
        web = extrude(tangent_hull(first * inset, second * inset, reach), thick, -thick / 2)
    else:
        web = box((reach, second * draw.uniform(0.8, 1.6), thick), (reach / 2, 0, 0))
    tall, low = thick * draw.uniform(1.2, 3.0), thick * draw.uniform(1.1, 2.5)
    solid = union(
        web,
        turned(
            [(0.0, -tall / 2), (first, -tall / 2), (first, tall / 2), (0.0, tall / 2)],
            [0, *[-0.03 * chance(draw, 0.5)] * 2, 0],
        ),
        cylinder(second, low, (reach, 0, -low / 2 + (tall - low) / 2 * chance(draw, 0.3))),
    )
    bore = first * draw.uniform(0.35, 0.65)
    cuts = [cylinder(bore, 4, (0, 0, -2)), place(drill(second * draw.uniform(0.3, 0.6), 4, 0.0), (reach, 0, 2))]
    if chance(draw, 0.4):
        cuts.append(box((bore * 1.3, bore * 0.5, 4), (-bore * 0.65, 0, 0)))
    if chance(draw, 0.4):
        cuts.append(extrude(stadium(reach * 0.25, second * 0.25), 4, -2))
        cuts[-1] = place(cuts[-1], (first + (reach - first - second) / 2, 0, 0))
    if chance(draw, 0.3):
        cuts.append(box((second * 3, draw.uniform(0.06, 0.15), 4), (reach + second * 1.3, 0, 0)))
    return difference(solid, *cuts)


def hinge(draw: np.random.Generator) -> Solid:
    """A leaf with screw holes and knuckles along its edge."""
    width, thick = draw.uniform(0.6, 1.3), draw.uniform(0.08, 0.2)
    eye = thick * draw.uniform(0.9, 1.5)
    count = int(draw.integers(2, 5))
    solid = union(
        box((2, width, thick), (0, width / 2, thick / 2)), cylinder(eye, 2, (-1, 0, eye * draw.uniform(0.3, 1.0)), "x")
    )
    pitch = 2 / (2 * count - 1)
    gaps = [box((pitch * 1.02, 3 * eye, 4), (-1 + pitch * (2 * j + 1.5), 0, 0)) for j in range(count - 1)]
    holes = []
    size = min(width * 0.1, 0.12)
    number = int(draw.integers(2, 4))
    for x in np.linspace(-0.75, 0.75, number):
        holes.append(place(drill(size, 1.0, 0.0, size * 0.6 * chance(draw, 0.6)), (float(x), width * 0.65, thick)))
    solid = difference(solid, *gaps, *holes)
    if chance(draw, 0.4):
        keep = extrude(rectangle(2, 2 * width, width * draw.uniform(0.15, 0.3)), 4, -2)
        solid = intersection(solid, keep)
    return solid


def rounded_prism(draw: np.random.Generator) -> Solid:
    """Extruded outlines with rounded corners (fillets that are parts of cylinders), perhaps hollow or pierced."""
    sides = int(draw.integers(3, 8))
    angle = np.sort((np.arange(sides) + draw.uniform(-0.25, 0.25, sides)) * 2 * np.pi / sides)
    reach = draw.uniform(0.6, 1.0, sides)
    points = [(float(r * np.cos(a)), float(r * np.sin(a))) for r, a in zip(reach, angle, strict=True)]
    size = draw.uniform(0.05, 0.2)
    profile = polygon(points, [size * chance(draw, 0.75) for _ in points])
    height = draw.uniform(0.15, 1.8)
    solid = extrude(profile, height)
    cuts = []
    if chance(draw, 0.5):
        scale = draw.uniform(0.5, 0.75)
        inner = polygon([(x * scale, y * scale) for x, y in points], size * 0.6 * chance(draw, 0.6))
        cuts.append(extrude(inner, 4, height * draw.uniform(0.2, 0.6) if chance(draw, 0.6) else -1.0))
    else:
        cuts.append(
            place(
                drill(
                    draw.uniform(0.12, 0.3), height * draw.uniform(0.3, 0.8), drill_end(draw), 0.05 * chance(draw, 0.5)
                ),
                (0, 0, height),
            )
        )
        if chance(draw, 0.4):
            solid = union(solid, cylinder(0.4, draw.uniform(0.1, 0.4) + 0.1, (0, 0, height - 0.1)))
    if chance(draw, 0.3) and height > 0.5:
        cuts.append(cylinder(height * draw.uniform(0.1, 0.2), 4, (-2, 0, height / 2), "x"))
    return difference(solid, *cuts)


def hub_plate(draw: np.random.Generator) -> Solid:
    """A square or round base with a central boss, ribs around it and holes in the corners."""
    base = rectangle(2, 2, draw.uniform(0.1, 0.4)) if chance(draw, 0.6) else disc(1.0)
    thick, boss, tall = draw.uniform(0.1, 0.25), draw.uniform(0.3, 0.5), draw.uniform(0.4, 1.2)
    top = boss * draw.uniform(0.7, 1.0) if chance(draw, 0.5) else boss
    solid = union(
        extrude(base, thick), turned([(0.0, 0.0), (boss, 0.0), (boss, thick), (top, thick + tall), (0.0, thick + tall)])
    )
    count = int(draw.choice([0, 2, 3, 4]))
    if count:
        triangle = polygon(
            [(0.0, 0.02), (draw.uniform(0.75, 0.95), 0.02), (0.0, thick + tall * draw.uniform(0.5, 0.9))]
        )
        sheet = draw.uniform(0.1, 0.2)
        rib = rotate(extrude(triangle, sheet, -sheet / 2), np.pi / 2, "x")
        rib = place(rib, (0, 0, thick - 0.02))
        solid = union(solid, *ring(rib, count))
    hole = place(drill(draw.uniform(0.08, 0.14), 2.0, 0.0, 0.05 * chance(draw, 0.4)), (0.8, 0, thick))
    cuts = ring(hole, 4 if chance(draw, 0.7) else 3, np.pi / 4)
    bore = top * draw.uniform(0.4, 0.75)
    cuts.append(
        place(drill(bore, tall * 0.6 if chance(draw, 0.5) else 4.0, 1.03 * chance(draw, 0.5)), (0, 0, thick + tall))
    )
    return difference(solid, *cuts)


def dimpled_plate(draw: np.random.Generator) -> Solid:
    """A plate or a disc with rows of ball dimples, conical pits, domes and pegs."""
    thick = draw.uniform(0.15, 0.5)
    across = int(draw.integers(1, 4))
    along = int(draw.integers(max(2, across), 5))
    pitch = 2 / along
    wide = pitch * across
    if across == along and chance(draw, 0.6):
        solid: Solid = cylinder(1.3, thick, (0, 0, -thick))
    else:
        solid = extrude(rectangle(2, wide, pitch * 0.2 * chance(draw, 0.5)), thick, -thick)
    kinds = draw.choice(["dimple", "dome", "pit", "peg", "none"], p=[0.4, 0.25, 0.15, 0.1, 0.1], size=2)
    size = pitch * draw.uniform(0.2, 0.4)
    for place_number in range(along * across):
        i, j = divmod(place_number, across)
        spot = (-1 + pitch * (i + 0.5), pitch * (j + 0.5) - wide / 2)
        high = draw.uniform(0.1, 0.5) * size
        match kinds[(i + j) % 2]:
            case "dimple":
                depth = min(size * 0.6, thick * 0.7)
                solid = difference(solid, sphere(size, (*spot, size - depth)))
            case "dome":
                solid = union(solid, sphere(size, (*spot, -high)))
            case "pit":
                fall = min(size, thick * 0.8)
                solid = difference(solid, place(frustum(0.0, size * 1.1, fall * 1.1), (*spot, -fall)))
            case "peg":
                solid = union(solid, cylinder(size * 0.6, high + 0.3, (*spot, -0.05)))
    return solid
