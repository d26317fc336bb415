"""Bodies to build solids from: boxes, turned and extruded profiles, drills, and how to place them.

A profile is a closed outline of straight segments and circular arcs in a plane. Extruded along z its segments become
planes and its arcs cylinders; turned about z (profile coordinates: radius, z) segments become planes, cylinders or
cones, arcs centred on the axis spheres, and other arcs belong to a torus, which is no primitive of ours.
Circles are cut into chords that stay within a fixed distance of the arc, for solids about 2 units long.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jprimfit.data.solids import Body, Solid, Surface, transform, triangulate
from jprimfit.types import Cone, Cylinder, Plane, Sphere

Real = float | int

_CHORD, _ARC_CHORD = 0.002, 0.004  # largest distance of a chord from its circle: around an axis, along a turned arc
_MIN_SEGMENTS, _MAX_SEGMENTS = 24, 72  # of a whole circle
_AXES = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}
_TINY = 1e-9


class Profile(NamedTuple):
    """A closed outline without crossings; edge j runs from points[j] to the next point along an arc of sweeps[j]."""

    points: Float[np.ndarray, "k 2"]
    sweeps: Float[np.ndarray, "k"]  # signed angle, positive = counter-clockwise, 0 = straight


def polygon(points: Sequence[Sequence[Real]], radius: Real | Sequence[Real] = 0.0) -> Profile:
    """The polygon of these corners; radius, one for all or one per corner, rounds them.

    A corner of radius 0 stays sharp; a negative one is cut straight, a chamfer that starts -radius from the corner.
    """
    corners = np.asarray(points, np.float64)
    radii = np.broadcast_to(np.asarray(radius, np.float64), len(corners))
    outline, sweeps = [], []
    for corner, before, after, size in zip(
        corners, np.roll(corners, 1, 0), np.roll(corners, -1, 0), radii, strict=True
    ):
        inward, outward = _unit(corner - before), _unit(after - corner)
        turn = float(np.arctan2(inward[0] * outward[1] - inward[1] * outward[0], inward @ outward))
        if size == 0 or abs(turn) < 1e-6:
            outline.append(corner)
            sweeps.append(0.0)
            continue
        reach = size * np.tan(abs(turn) / 2) if size > 0 else -size
        outline += [corner - reach * inward, corner + reach * outward]
        sweeps += [turn if size > 0 else 0.0, 0.0]
    return Profile(np.array(outline), np.array(sweeps))


def regular(sides: int, across: Real, radius: Real = 0.0) -> Profile:
    """The regular polygon with this distance between opposite flats (sides even)."""
    angle = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    corners = across / 2 / np.cos(np.pi / sides) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return polygon(corners.tolist(), radius)


def rectangle(width: Real, height: Real, radius: Real = 0.0, center: Sequence[Real] = (0.0, 0.0)) -> Profile:
    """The rectangle with rounded corners about center."""
    x, y = width / 2, height / 2
    return polygon([(center[0] + a, center[1] + b) for a, b in ((-x, -y), (x, -y), (x, y), (-x, y))], radius)


def stadium(length: Real, radius: Real) -> Profile:
    """Two half circles, length between their centres, along x about the origin."""
    half = length / 2
    points = np.array([(-half, -radius), (half, -radius), (half, radius), (-half, radius)])
    return Profile(points, np.array([0.0, np.pi, 0.0, np.pi]))


def tangent_hull(first: Real, second: Real, distance: Real) -> Profile:
    """The outline of a belt around two circles: first about the origin, second about (distance, 0)."""
    angle = float(np.arccos((first - second) / distance))
    direction = np.array([np.cos(angle), np.sin(angle)])
    mirrored = direction * np.array([1.0, -1.0])
    shift = np.array([distance, 0.0])
    points = np.stack([first * mirrored, shift + second * mirrored, shift + second * direction, first * direction])
    return Profile(points, np.array([0.0, 2 * angle, 0.0, 2 * np.pi - 2 * angle]))


def disc(radius: Real, center: Sequence[Real] = (0.0, 0.0)) -> Profile:
    """The circle."""
    x, y = center
    return Profile(np.array([(x - radius, y), (x + radius, y)]), np.array([np.pi, np.pi]))


def extrude(profile: Profile, height: Real, base: Real = 0.0) -> Body:
    """The prism over a profile in the xy plane, from z = base to base + height."""
    outline, edge = _discretise(profile, chord=_CHORD)
    size = len(outline)
    lower, upper = (np.column_stack([outline, np.full(size, z)]) for z in (base, base + height))
    here = np.arange(size)
    there = np.roll(here, -1)
    caps = triangulate(outline)
    faces = np.concatenate(
        [
            np.stack([here, there, there + size], axis=1),
            np.stack([here, there + size, here + size], axis=1),
            caps[:, ::-1],
            caps + size,
        ]
    )
    count = len(profile.points)
    surface_index = np.concatenate([edge, edge, np.full(len(caps), count), np.full(len(caps), count + 1)])
    sides = tuple(_wall(profile, row) for row in range(count))
    up = np.array([0.0, 0.0, 1.0])
    ends = (Plane(up, np.float64(base)), Plane(up, np.float64(base + height)))
    return Body(np.concatenate([lower, upper]), faces, surface_index, sides + ends)


def revolve(profile: Profile) -> Body:
    """The profile (radius, z) turned about the z axis; the part of its outline on the axis leaves no face."""
    outline, edge = _discretise(profile, chord=_ARC_CHORD)
    outline = np.where(np.abs(outline) < _TINY, 0.0, outline)
    count = segments(float(np.max(outline[:, 0])))
    angle = np.arange(count) * 2 * np.pi / count
    radius, height = outline[:, :1], np.repeat(outline[:, 1:], count, axis=1)
    vertices = np.stack([radius * np.cos(angle)[None], radius * np.sin(angle)[None], height], axis=-1).reshape(-1, 3)
    row = np.arange(len(outline))[:, None] * count
    # All copies of a point on the axis are one vertex; triangles with two corners there vanish.
    ring = np.where(outline[:, :1] == 0, row, row + np.arange(count)[None])
    here, there, turned = ring, np.roll(ring, -1, axis=0), np.roll(ring, -1, axis=1)
    corner = np.roll(turned, -1, axis=0)
    quads = np.stack([np.stack([here, turned, corner], -1), np.stack([here, corner, there], -1)]).reshape(-1, 3)
    surface_index = np.tile(np.repeat(edge, count), 2)
    a, b, c = quads.T
    solid = (a != b) & (b != c) & (a != c)
    used, faces = np.unique(quads[solid], return_inverse=True)
    surfaces = tuple(_turned(profile, row) for row in range(len(profile.points)))
    return _compact(Body(vertices[used], faces.reshape(-1, 3), surface_index[solid], surfaces))


def box(size: Sequence[Real], center: Sequence[Real] = (0.0, 0.0, 0.0)) -> Body:
    """The box with these side lengths about center."""
    return extrude(rectangle(size[0], size[1], center=center[:2]), size[2], center[2] - size[2] / 2)


def cylinder(radius: Real, height: Real, base: Sequence[Real] = (0.0, 0.0, 0.0), along: str = "z") -> Solid:
    """The cylinder that stands on base and runs along one of the axes."""
    return place(revolve(polygon([(0, 0), (radius, 0), (radius, height), (0, height)])), base, along)


def cone(low: Real, high: Real, height: Real, base: Sequence[Real] = (0.0, 0.0, 0.0), along: str = "z") -> Solid:
    """The frustum from radius low at base to radius high; one of them may be 0."""
    points = [(0, 0), (low, 0), (high, height), (0, height)]
    return place(revolve(polygon([p for j, p in enumerate(points) if j in (0, 3) or p[0] > 0])), base, along)


def sphere(radius: Real, center: Sequence[Real] = (0.0, 0.0, 0.0)) -> Solid:
    """The ball about center."""
    outline = Profile(np.array([(0.0, -radius), (0.0, radius)]), np.array([np.pi, 0.0]))
    return place(revolve(outline), center)


def drill(radius: Real, depth: Real, tip: Real = 0.0, chamfer: Real = 0.0) -> Body:
    """What a drill removes that enters the plane z = 0 downwards: a cylinder, its end, a chamfer around its mouth.

    The end is flat (tip 0), a cone of half-angle tip, or a half ball (tip negative).
    """
    bottom = [(0.0, -depth - radius / np.tan(tip))] if tip > 0 else [(0.0, -depth - radius * (tip < 0))]
    foot, wall = (radius, -depth), [(radius, -chamfer)] if chamfer > 0 else []
    rim = radius + chamfer
    # The mouth rises above the plane (with the same cone), so that no faces of the cut coincide with the part's.
    mouth = [(rim + 0.05, 0.05), (0.0, 0.05)] if chamfer > 0 else [(radius, 0.05), (0.0, 0.05)]
    outline = polygon([*bottom, foot, *wall, *mouth])
    sweeps = outline.sweeps.copy()
    sweeps[0] = np.pi / 2 if tip < 0 else 0.0
    return revolve(outline._replace(sweeps=sweeps))


def place(solid: Solid, at: Sequence[Real] = (0.0, 0.0, 0.0), along: str = "z") -> Solid:
    """The solid with its z axis turned onto the axis named (a leading - turns it over) and its origin moved to at."""
    turn = np.roll(np.eye(3), "zxy".index(along[-1]), axis=0)
    if along.startswith("-"):
        turn = turn @ np.diag([1.0, -1.0, -1.0])
    return transform(solid, turn, np.asarray(at, np.float64))


def rotate(solid: Solid, angle: Real, axis: str = "z") -> Solid:
    """The solid turned by an angle about a coordinate axis through the origin."""
    c, s = (0.0 if abs(value) < 1e-15 else value for value in (np.cos(angle), np.sin(angle)))
    one, two, _ = _AXES[axis]
    turn = np.eye(3)
    turn[[one, one, two, two], [one, two, one, two]] = c, -s, s, c
    return transform(solid, turn, np.zeros(3))


def ring(solid: Solid, count: int, phase: Real = 0.0) -> list[Solid]:
    """Copies of the solid evenly spread about the z axis."""
    return [rotate(solid, phase + j * 2 * np.pi / count) for j in range(count)]


def segments(radius: Real, chord: Real = _CHORD) -> int:
    """The number of chords of a whole circle, a multiple of four."""
    step = 2 * np.arccos(1 - min(chord / max(radius, chord), 0.9))
    return int(np.clip(4 * np.ceil(2 * np.pi / step / 4), _MIN_SEGMENTS, _MAX_SEGMENTS))


def _discretise(profile: Profile, *, chord: Real) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the outline, counter-clockwise, and for the segment that starts at each the edge it belongs to."""
    outline, edge = [], []
    for row, (start, end, sweep) in enumerate(_edges(profile)):
        steps = 1
        if sweep:
            center = _center(start, end, sweep)
            whole = segments(float(np.hypot(*(start - center))), chord)
            steps = max(4, int(np.ceil(whole * abs(sweep) / (2 * np.pi))))
            angle = sweep * np.arange(steps)[:, None] / steps
            spoke = (start - center)[None]
            outline.append(center + np.cos(angle) * spoke + np.sin(angle) * spoke[:, ::-1] * np.array([[-1.0, 1.0]]))
        else:
            outline.append(start[None])
        edge.append(np.full(steps, row))
    points, edges = np.concatenate(outline), np.concatenate(edge)
    after = np.roll(points, -1, axis=0)
    if np.sum(points[:, 0] * after[:, 1] - points[:, 1] * after[:, 0]) < 0:
        points, edges = points[::-1], np.roll(edges[::-1], -1)
    return points, edges


def _edges(profile: Profile):
    return zip(profile.points, np.roll(profile.points, -1, axis=0), profile.sweeps.tolist(), strict=True)


def _center(start: np.ndarray, end: np.ndarray, sweep: Real) -> np.ndarray:
    chord = end - start
    return (start + end) / 2 + np.array([-chord[1], chord[0]]) / 2 / np.tan(sweep / 2)


def _wall(profile: Profile, row: int) -> Surface:
    """The surface over edge row of an extruded profile."""
    start, end, sweep = list(_edges(profile))[row]
    if sweep:
        center = _center(start, end, sweep)
        return Cylinder(np.array([0.0, 0.0, 1.0]), np.append(center, 0.0), np.hypot(*(start - center)))
    normal = np.append(_unit(end - start), 0.0)[[1, 0, 2]] * np.array([1.0, -1.0, 1.0])
    return Plane(normal, normal[:2] @ start)


def _turned(profile: Profile, row: int) -> Surface:
    """The surface that edge row of a turned profile sweeps."""
    start, end, sweep = list(_edges(profile))[row]
    if sweep:
        center = _center(start, end, sweep)
        on_axis = abs(center[0]) < _TINY
        return Sphere(np.array([0.0, 0.0, center[1]]), np.hypot(*(start - center))) if on_axis else None
    (r0, z0), (r1, z1) = start, end
    up = np.array([0.0, 0.0, 1.0])
    if abs(z1 - z0) < _TINY:
        return Plane(up, np.float64(z0))
    if abs(r1 - r0) < _TINY:
        return Cylinder(up, np.zeros(3), np.float64(r0)) if r0 > _TINY else None
    slope = (r1 - r0) / (z1 - z0)
    return Cone(np.sign(slope) * up, np.array([0.0, 0.0, z0 - r0 / slope]), np.arctan(abs(slope)))


def _compact(body: Body) -> Body:
    """The body without surfaces that no face lies on."""
    kept, surface_index = np.unique(body.surface_index, return_inverse=True)
    return body._replace(surface_index=surface_index, surfaces=tuple(body.surfaces[row] for row in kept))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.hypot(*vector)
