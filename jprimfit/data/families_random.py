"""Training families without a purpose: random booleans of boxes, cylinders, cones and balls, and random profiles.

They show the network combinations that no catalogue has.
"""

import numpy as np

from jprimfit.data.families_turned import chance, turned
from jprimfit.data.shapes import box, cone, cylinder, extrude, place, polygon, regular, rotate, sphere
from jprimfit.data.solids import Solid, difference, union


def _block(draw: np.random.Generator, size: float) -> Solid:
    """One of the building blocks about its centre, about size long."""
    a, b, c = (size * draw.uniform(0.4, 1.0, 3)).tolist()
    match draw.choice(["box", "cylinder", "cone", "sphere", "prism"], p=[0.3, 0.28, 0.18, 0.2, 0.04]):
        case "box":
            return box((a, b, c))
        case "cylinder":
            return cylinder(a / 2, b, (0, 0, -b / 2))
        case "cone":
            return cone(a / 2, a / 2 * draw.choice([0.0, draw.uniform(0.3, 0.8)]), b, (0, 0, -b / 2))
        case "sphere":
            return sphere(a / 2)
        case _:
            return extrude(regular(int(draw.choice([6, 8])), a), b, -b / 2)


def _turned_over(draw: np.random.Generator, solid: Solid) -> Solid:
    """Along a coordinate axis, or mildly oblique."""
    solid = place(solid, (0, 0, 0), str(draw.choice(["x", "y", "z", "-x", "-y", "-z"])))
    return rotate(solid, draw.uniform(0.2, 1.2), str(draw.choice(["x", "y", "z"]))) if chance(draw, 0.3) else solid


def random_solid(draw: np.random.Generator) -> Solid:
    """Two to six blocks, the first the largest, each of the others added to it or taken away."""
    solid = _turned_over(draw, _block(draw, 1.8))
    for _ in range(int(draw.integers(1, 6))):
        added = chance(draw, 0.5)
        other = _turned_over(draw, _block(draw, draw.uniform(0.5, 1.4)))
        other = place(other, tuple(draw.uniform(-0.6, 0.6, 3).tolist()))
        solid = union(solid, other) if added else difference(solid, other)
    return solid


def aligned_solid(draw: np.random.Generator) -> Solid:
    """Blocks stacked flush on an axis, with coaxial and crossing bores: coplanar faces that continue each other."""
    solid, top = None, 0.0
    for _ in range(int(draw.integers(2, 5))):
        height, wide = draw.uniform(0.2, 0.7), draw.uniform(0.4, 1.0)
        shape = draw.choice(["box", "cylinder", "cone", "hexagon"])
        if shape == "box":
            block = box((2 * wide, 2 * wide * draw.uniform(0.4, 1.0), height), (0, 0, top + height / 2))
        elif shape == "hexagon":
            block = extrude(regular(6, wide * 1.7), height, top)
        else:
            block = cone(wide, wide * (draw.uniform(0.5, 0.9) if shape == "cone" else 1.0), height, (0, 0, top))
        solid = block if solid is None else union(solid, block)
        top += height
    cuts: list[Solid] = []
    if chance(draw, 0.7):
        cuts.append(
            cylinder(draw.uniform(0.1, 0.3), top * 4, (0, 0, top * draw.uniform(0.2, 0.8) if chance(draw, 0.5) else -1))
        )
    if chance(draw, 0.5):
        along = str(draw.choice(["x", "y"]))
        start = (-4, 0, top * draw.uniform(0.2, 0.8)) if along == "x" else (0, -4, top * draw.uniform(0.2, 0.8))
        cuts.append(cylinder(top * draw.uniform(0.06, 0.18), 8, start, along))
    if chance(draw, 0.3):
        cuts.append(box((4, draw.uniform(0.1, 0.4), top), (0, 0, top)))
    assert solid is not None
    return difference(solid, *cuts)


def random_profile(draw: np.random.Generator) -> Solid:
    """A random rectilinear or bevelled outline turned about an axis or extruded, then pierced."""
    count = int(draw.integers(3, 7))
    cut = np.sort(draw.uniform(0, 2, count - 1))
    edges = [0.0, *cut.tolist(), 2.0]
    level = draw.uniform(0.25, 0.9, count)
    points: list[tuple[float, float]] = []
    for j in range(count):
        slope = draw.uniform(-0.15, 0.15) if chance(draw, 0.3) else 0.0
        points += [(float(level[j]), edges[j]), (float(level[j] + slope), edges[j + 1])]
    if chance(draw, 0.5):
        inner = draw.uniform(0.05, 0.18) if chance(draw, 0.6) else 0.0
        solid = turned([(inner, 0.0), *points, (inner, 2.0)])
    else:
        depth = draw.uniform(0.3, 1.4)
        solid = rotate(extrude(polygon([(-0.2, 0.0), *points, (-0.2, 2.0)]), depth, -depth / 2), np.pi / 2, "x")
    cuts: list[Solid] = []
    for _ in range(int(draw.integers(0, 3))):
        tool = _turned_over(draw, _block(draw, draw.uniform(0.3, 0.8)))
        cuts.append(place(tool, (draw.uniform(0.2, 0.8), draw.uniform(-0.4, 0.4), draw.uniform(0.0, 2.0))))
    return difference(solid, *cuts)
