"""How far primitives reach: length, width, end radii, arc, solid angle and outline of the surface that was seen.

Lengths end on edges where the patch does (edges.py), else, as arcs do, where the points do. The outermost of n random
points lies a gap short of the end, under noise beyond it: `ends` corrects both by counting, since noise carries no
point away. Areas and outlines come from the trimmed patch (patches.py). Points beyond the patch, strays on the
surface's continuation, do not count.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.spatial import ConvexHull, KDTree, QhullError

from jprimfit.cad import charts, outlines, patches
from jprimfit.cad.patches import Patch
from jprimfit.types import Cone, Cylinder, Loop, Plane, Primitive, Sphere

TAIL = 8  # points beyond the place from which an end is extrapolated; more where noise blurs it
BLUR = 5.0  # standard deviations of noise between that place and the outermost point
FULL_ODDS = 1e-3  # that the widest gap between random points of a full turn is taken for a real one
FULL_SPACINGS = 4.0  # rows of a regular scan leave gaps of two
NEAR = 1.5  # lengths of the patch's longest edges within which a point belongs to it
AREA_ROUNDS = 5
MOST_GAPS = 8.0  # beyond the outermost point, where a tail is sparser than what is behind it
TAPERED = 3.2  # growth below which a density tapers: 4 is even, 2 that of a corner
TIP = 0.6  # how far the end of a corner may lie beyond its outermost point, over what the tail reaches back
SAME_BOX = 1.02  # boxes of so nearly the least area are alike: a triangle has one on each side
SAME_SIDE = 0.1  # radians between boxes of which only the lesser counts
ROUGH = 1.5  # edges of the patch by which a corner of a boundary may lie off a circle
NUM_WAVES = 8  # per turn: what a boundary is searched for that is no circle
ROUND = 0.02  # root mean square of those, in radii: a hexagon has 0.04, an ellipse of 0.95 has 0.02
NARROW = 0.05  # of the largest radius of a cone: within it angles say little
SURE = 0.9  # of the corners of a flat face that lie on edges: then they and not its points make the rectangle
OUTLINE_TOLERANCE = 0.8  # in edges of the patch, as in a STEP file


def extents(primitive: Primitive, points: Float[np.ndarray, "n 3"], patch: Patch, *, blur: float) -> dict[str, Any]:
    """The fields of types.Feature that say how far a primitive reaches, those of its kind only.

    Args:
        primitive: finite, in the frame of the points.
        points: of its segment; none gives the position and an area of 0 alone.
        patch: the primitive trimmed to them; where it is empty all points count and the area is 0.
        blur: standard deviation of the points' noise, length.
    """
    feet = _seen(charts.feet(primitive, points), patch)
    spacing = patches.sample_spacing(feet)
    area = surface_area(patch, len(feet), spacing)
    if isinstance(primitive, Sphere):
        center, radius = np.asarray(primitive.center, np.float64), float(primitive.radius)
        return {"position": center, "area": area, "solid_angle": min(area / radius**2, 4 * np.pi) if area else None}
    if isinstance(primitive, Plane):
        loops = outline(primitive, patch)
        found = _disc(loops) or _box(primitive, feet, blur, patch)
        most = found["length"] * found["width"] if len(feet) else np.inf
        return {"outline": loops, **found, "area": min(area, most)}
    found = _reach(primitive, feet, spacing, blur, patch)
    # A piece cut straight fills its rectangle of arc and length, nothing fills more.
    most = found["arc"] * np.hypot(np.diff(found["end_radii"])[0], found["length"]) if len(feet) else np.inf
    return {**found, "area": min(area, float(most * np.mean(found.get("end_radii", 1.0))))}


def surface_area(patch: Patch, num_points: int, spacing: float) -> float:
    """Area of a patch, its rim as wide as an even sample of so many points needs it; squared length.

    Edges with another face are where they are. Elsewhere the rim stands for the spacing s = sqrt(area / n) / 2. On
    strips of a few spacings the spacing that the patch was made with (`spacing`) is too large, as neighbours lie in a
    row: what the boundary gained by that is taken off again.
    """
    area = patches.area(patch)
    edges = patches.boundary_edges(patch)
    if patch.edge is not None:
        edges = edges[(patch.edge[edges] < 0).any(axis=1)]
    if len(edges) == 0 or num_points == 0:
        return area
    boundary = float(np.sum(np.sqrt(np.sum((patch.vertices[edges[:, 0]] - patch.vertices[edges[:, 1]]) ** 2, axis=1))))
    rim = patches.RIM * patches.CELL
    corrected = area
    for _ in range(AREA_ROUNDS):
        excess = rim * (spacing - np.sqrt(corrected / num_points) / 2)
        corrected = area - boundary * max(float(excess), 0.0)
        if corrected < area / 2:
            return area
    return corrected


def ends(values: Float[np.ndarray, "n"], *, blur: float, tapered: bool = False) -> tuple[float, float]:
    """Where the density of points along a line begins and ends, free of bias where it is even up to there.

    blur: standard deviation of the values' noise. Without it the end is a mean gap behind the outermost point. With x
    the place that k points lie beyond, it is also k + 1 gaps behind x, and that noise does not change: it carries
    points across the end in both directions, but across x in equal numbers. k grows until the noise cannot reach x.
    tapered: the density may fall off towards the end, as over a corner or an arc of a flat face: then the number of
    points within t of the end grows like t^a, and a (1 to 2) is taken from how it grows further in.
    """
    ordered = np.sort(values)
    return -_end(-ordered[::-1], blur, tapered), _end(ordered, blur, tapered)


def _end(ordered: Float64[np.ndarray, "n"], blur: float, tapered: bool) -> float:
    last = len(ordered) - 1
    depth = TAIL
    while 4 * depth <= last and ordered[last] - ordered[last - depth] < BLUR * blur:
        depth += depth // 2
    depth = min(depth, last // 4)
    if depth == 0:
        return float(ordered[last])
    within = min(4 * depth, last - depth)  # as far from the other end, where noise blurs too
    place, inner = ordered[last - depth], ordered[last - within]
    gap = (place - inner) / (within - depth)
    if tapered and 16 * depth <= last and gap > 0.0:
        # Four times as many points lie within 4^(1/a) times the distance.
        growth = max((inner - ordered[last - 16 * depth]) / (place - inner), 2.0)
        if growth < TAPERED:
            end = place + (place - inner) / (growth - 1)
            return float(end if blur > gap else min(end, ordered[last] + TIP * (ordered[last] - place)))
    if blur < gap:
        return float(ordered[last] + gap)
    return float(min(place + (depth + 1) * gap, ordered[last] + MOST_GAPS * gap))


def _sure(patch: Patch) -> Bool[np.ndarray, " v"]:
    """The vertices that the surface certainly reaches: inside the patch, or on its edge with another face."""
    sure = np.ones(len(patch.vertices), bool)
    sure[patches.boundary_edges(patch)] = False
    return sure if patch.edge is None else sure | (patch.edge >= 0)


def _settled(found: tuple[float, float], values: Float64[np.ndarray, " v"], sure: Bool[np.ndarray, " v"]):
    """The ends of the patch in the place of those found, where it is sure of them; values: of its vertices."""
    if not len(values):
        return found
    first, last = int(np.argmin(values)), int(np.argmax(values))
    return (
        float(values[first]) if sure[first] else found[0],
        float(values[last]) if sure[last] else found[1],
    )


def turn(angles: Float[np.ndarray, "n"], *, gap: float, blur: float) -> float:
    """The turn without its widest gap, 2 pi where that is no wider than `gap` or than chance would leave."""
    chance = 2 * np.pi * np.log(max(len(angles), 2) / FULL_ODDS) / max(len(angles), 2)
    interval = charts.angular_interval(angles, gap=max(gap, chance))
    if interval.full:
        return 2 * np.pi
    low, high = ends(np.mod(angles - interval.start + 1e-9, 2 * np.pi), blur=blur)
    return float(min(max(high - low, 0.0), 2 * np.pi))


def outline(plane: Plane, patch: Patch) -> tuple[Loop, ...]:
    """The boundaries of a flat patch, as circles or polygons of few corners, on the plane."""
    if len(patch.faces) == 0:
        return ()
    axes = charts.frame(np.asarray(plane.normal))
    origin = patch.vertices.mean(axis=0)
    edge = float(np.sqrt(4 / np.sqrt(3) * patches.area(patch) / len(patch.faces)))
    loops = []
    for rows in patches.boundary_loops(patch):
        flat = (patch.vertices[rows] - origin[None, :]) @ axes[:2].T
        circle = _circle(flat, edge)
        if circle is not None:
            loops.append(Loop(np.zeros((0, 3)), origin + circle.center @ axes[:2], circle.radius))
        else:
            corners = outlines.simplified(flat, tolerance=OUTLINE_TOLERANCE * edge)
            loops.append(Loop(origin[None, :] + corners @ axes[:2]))
    return tuple(loops)


def _circle(loop: Float64[np.ndarray, "k 2"], edge: float) -> outlines.Circle | None:
    """The circle that a ragged loop stands for: rough within edges of the patch, but with no corners or flats."""
    circle = outlines.circle(loop, tolerance=ROUGH * edge)
    if circle is None or len(loop) <= 2 * NUM_WAVES:
        return circle
    x, y = (loop - circle.center[None, :]).T
    angle = np.arctan2(y, x)[:, None] * np.arange(2, NUM_WAVES + 1)[None, :]
    waves = np.concatenate([np.ones((len(loop), 1)), np.cos(angle), np.sin(angle)], axis=1)
    residual = np.hypot(x, y) - circle.radius
    shape = waves @ np.linalg.lstsq(waves, residual, rcond=None)[0]
    return circle if np.sqrt(np.mean(shape**2)) < ROUND * circle.radius else None


def _disc(loops: tuple[Loop, ...]) -> dict[str, Any] | None:
    """Position, length and width of a face whose only outer boundary is a circle, the largest; None for any other."""
    if not loops:
        return None
    sizes = [2 * loop.radius if loop.radius else float(np.ptp(loop.corners, axis=0).max()) for loop in loops]
    largest = loops[int(np.argmax(sizes))]
    if largest.radius is None:
        return None
    return {"position": largest.center, "length": 2 * largest.radius, "width": 2 * largest.radius}


def _seen(feet: Float64[np.ndarray, "n 3"], patch: Patch) -> Float64[np.ndarray, "m 3"]:
    """The feet that lie on the patch; all where that is empty."""
    if len(patch.faces) == 0:
        return feet
    ends_of_edges = patch.vertices[charts.edges(patch.faces)[0]]
    longest = float(np.sqrt(np.max(np.sum((ends_of_edges[:, 0] - ends_of_edges[:, 1]) ** 2, axis=1))))
    distance = KDTree(patch.vertices).query(feet, distance_upper_bound=NEAR * longest)[0]
    return feet[np.isfinite(distance)]


def _box(plane: Plane, feet: Float64[np.ndarray, "n 3"], blur: float, patch: Patch | None = None) -> dict[str, Any]:
    """Middle, length and width of the rectangle of least area around all points; a side of it lies on their hull."""
    normal = np.asarray(plane.normal, np.float64)
    if len(feet) == 0:
        return {"position": float(plane.offset) * normal}
    axes, origin = charts.frame(normal), feet.mean(axis=0)
    flat = (feet - origin[None, :]) @ axes[:2].T
    corners = flat[_hull(flat)]
    if patch is not None and len(patch.faces):
        vertices, sure = (patch.vertices - origin[None, :]) @ axes[:2].T, _sure(patch)
        rows = _hull(vertices)
        corners = vertices[rows] if sure[rows].mean() >= SURE else corners
    sides = np.roll(corners, -1, axis=0) - corners
    angles = np.unique(np.mod(np.arctan2(sides[:, 1], sides[:, 0]), np.pi / 2))
    cosine, sine = np.cos(angles)[:, None], np.sin(angles)[:, None]
    along = cosine * corners[None, :, 0] + sine * corners[None, :, 1]
    across = -sine * corners[None, :, 0] + cosine * corners[None, :, 1]
    sides = np.stack([np.ptp(along, axis=1), np.ptp(across, axis=1)], axis=1)
    size = sides.prod(axis=1)
    apart = np.abs(angles[:, None] - angles[None, :])
    near = np.minimum(apart, np.pi / 2 - apart) < SAME_SIDE
    least = size <= np.where(near, size[None, :], np.inf).min(axis=1)
    best = int(np.argmax(np.where(least & (size <= SAME_BOX * size.min()), sides.max(axis=1), -1.0)))
    turned = np.array([[np.cos(angles[best]), np.sin(angles[best])], [-np.sin(angles[best]), np.cos(angles[best])]])
    reached = [ends(values, blur=blur, tapered=True) for values in turned @ flat.T]
    if patch is not None and len(patch.faces):
        reached = [_settled(found, values, sure) for found, values in zip(reached, turned @ vertices.T, strict=True)]
    low, high = np.array(reached).T
    width, length = sorted((high - low).tolist())
    return {"position": origin + ((low + high) / 2 @ turned) @ axes[:2], "length": length, "width": width}


def _hull(flat: Float64[np.ndarray, "n 2"]) -> Int[np.ndarray, " h"]:
    """Rows of the corners of the convex hull in order; all rows where there is none."""
    try:
        return ConvexHull(flat).vertices
    except (QhullError, ValueError):  # fewer than three points, or all on one line
        return np.arange(len(flat))


def _reach(
    primitive: Cylinder | Cone, feet: Float64[np.ndarray, "n 3"], spacing: float, blur: float, patch: Patch
) -> dict[str, Any]:
    """Ends, the radii there, the length between them and the arc of a cylinder or cone."""
    is_cone = isinstance(primitive, Cone)
    origin = np.asarray(primitive.apex if is_cone else primitive.center, np.float64)
    if len(feet) == 0:
        return {"position": origin}
    axes = charts.frame(np.asarray(primitive.axis))
    local = (feet - origin[None, :]) @ axes.T
    low, high = _ends_of_cone(local[:, 2], blur) if is_cone else ends(local[:, 2], blur=blur)
    low, high = _settled((low, high), (patch.vertices - origin[None, :]) @ axes[2], _sure(patch))
    slope = float(np.tan(float(primitive.half_angle))) if is_cone else 0.0
    radii = (low * slope, high * slope) if is_cone else (float(primitive.radius),) * 2
    distance = np.hypot(local[:, 0], local[:, 1])
    wide = distance >= max(NARROW * distance.max(), min(BLUR * blur, distance.max()))
    radius = max(float(np.mean(distance[wide])), np.finfo(float).tiny)
    angles = np.arctan2(local[wide, 1], local[wide, 0])
    arc = turn(angles, gap=FULL_SPACINGS * spacing / radius, blur=blur / radius)
    places = origin[None, :] + np.array([[low], [high]]) * axes[2][None, :]
    return {
        "position": places.mean(axis=0),
        "length": high - low,
        "ends": places,
        "end_radii": (float(radii[0]), float(radii[1])),
        "arc": arc,
    }


def _ends_of_cone(heights: Float64[np.ndarray, "n"], blur: float) -> tuple[float, float]:
    """The lowest and highest place on a cone: points are spread evenly over the square of the height, tip or no tip."""
    squares = np.maximum(heights, 0.0) ** 2
    low, high = np.sqrt(squares.min()), np.sqrt(squares.max())
    low = ends(squares, blur=2 * low * blur)[0]
    high = ends(squares, blur=2 * high * blur)[1]
    return float(np.sqrt(max(low, 0.0))), float(np.sqrt(max(high, 0.0)))
