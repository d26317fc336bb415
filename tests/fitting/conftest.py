"""Small scans of parts whose surfaces are known, and NumPy's own distances to them; offered as the fixture `parts`.

Points lie on jittered lattices or spirals, so that the density is even and no two rows coincide; the step is about the
distance of neighbours. All have 500 to 1,300 points, which keeps to a few compiled sizes.
"""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

X, Y, Z = np.eye(3)


class Part(NamedTuple):
    """A scan and its truth."""

    points: np.ndarray  # (n, 3)
    normals: np.ndarray  # (n, 3), unit
    labels: np.ndarray  # (n,), row of primitives
    primitives: tuple[Primitive, ...]

    def noisy(self, sigma, seed=0):
        """The points moved along their normals."""
        return self.points + sigma * np.random.default_rng(seed).normal(size=(len(self.points), 1)) * self.normals


def lattice(width, height, step, rng):
    """Rows (u, v) of a jittered lattice in [0, width] x [0, height], none nearer to the border than step / 5."""
    u, v = np.meshgrid(*(np.arange(round(side / step)) + 0.5 for side in (width, height)), indexing="ij")
    cells = np.stack([u.ravel(), v.ravel()], axis=1) + rng.uniform(-0.3, 0.3, (u.size, 2))
    return cells * [[width / len(u), height / u.shape[1]]]


def spiral(num, low, high):
    """Distance from the centre and angle of points that cover the ring between two radii evenly."""
    row = np.arange(num) + 0.5
    return np.sqrt(low**2 + (high**2 - low**2) * row / num), np.pi * (1 + np.sqrt(5)) * row


def rectangle(corner, side_u, side_v, *, step, rng):
    """The points corner + u·side_u + v·side_v, u and v in [0, 1], their normals and plane."""
    corner, sides = np.asarray(corner, float), np.array([side_u, side_v], float)
    lengths = np.linalg.norm(sides, axis=1)
    points = corner[None] + lattice(*lengths, step, rng) / lengths[None] @ sides
    normal = np.cross(*(sides / lengths[:, None]))
    normal *= np.sign(normal[np.abs(normal).argmax()])
    return points, np.tile(normal, (len(points), 1)), Plane(normal, normal @ corner)


def ring(height, low, high, *, step):
    """A horizontal disc around the z axis without the part within the radius low."""
    radius, angle = spiral(round(np.pi * (high**2 - low**2) / step**2), low, high)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(len(angle), height)], axis=1)
    return points, np.tile(Z, (len(points), 1)), Plane(Z, height)


def tube(center, radius, height, *, step, rng, axis=2, start=0.0, turn=2 * np.pi):
    """A cylinder from center along a coordinate axis, between two angles."""
    arc, rise = lattice(turn * radius, height, step, rng).T
    angle = start + arc / radius
    along, first, second = np.roll(np.eye(3), -axis, axis=0)
    normals = np.cos(angle)[:, None] * first[None] + np.sin(angle)[:, None] * second[None]
    center = np.asarray(center, float)
    return center[None] + radius * normals + rise[:, None] * along[None], normals, Cylinder(along, center, radius)


def funnel(apex, half_angle, low, high, *, step):
    """A cone that opens upwards from the apex, between two distances from it along the surface."""
    along, angle = spiral(round(np.pi * np.sin(half_angle) * (high**2 - low**2) / step**2), low, high)
    across = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    points = along[:, None] * (np.sin(half_angle) * across + np.cos(half_angle) * Z[None])
    apex = np.asarray(apex, float)
    normals = np.cos(half_angle) * across - np.sin(half_angle) * Z[None]
    return apex[None] + points, normals, Cone(Z, apex, half_angle)


def ball(center, radius, *, step, lowest=-1.0):
    """The part of a sphere above center + lowest·radius."""
    num = round(2 * np.pi * radius**2 * (1 - lowest) / step**2)
    height = 1 - (1 - lowest) * (np.arange(num) + 0.5) / num
    width, angle = np.sqrt(1 - height**2), spiral(num, 0, 1)[1]
    normals = np.stack([width * np.cos(angle), width * np.sin(angle), height], axis=1)
    center = np.asarray(center, float)
    return center[None] + radius * normals, normals, Sphere(center, radius)


def join(*pieces):
    """One part of several pieces; piece i has the label i."""
    points, normals, primitives = zip(*pieces, strict=True)
    labels = np.repeat(np.arange(len(pieces)), [len(piece) for piece in points])
    return Part(np.concatenate(points), np.concatenate(normals), labels, primitives)


def boss(step=0.075, seed=0):
    """A plate with a cylinder standing on it, closed by a disc: sharp edges between three surfaces."""
    side = tube((0, 0, 0), 0.5, 0.8, step=step, rng=np.random.default_rng(seed))
    return join(ring(0.0, 0.5, 1.2, step=step), side, ring(0.8, 0.0, 0.5, step=step))


def ball_and_funnel(step=0.09):
    """A cone cut off below, and a sphere beside it that it does not touch."""
    return join(funnel((0, 0, -1), np.radians(30), 0.5, 1.8, step=step), ball((2, 0, 0), 0.6, step=step, lowest=-0.8))


def fillet(step=0.07, seed=0):
    """Two walls at a right angle, joined by a quarter of a cylinder that touches both without an edge."""
    make = {"step": step, "rng": np.random.default_rng(seed)}
    bend = tube((0.4, 0, 0.4), 0.4, 1.4, **make, axis=1, start=np.pi, turn=np.pi / 2)
    return join(
        rectangle((0.4, 0, 0), 1.2 * X, 1.4 * Y, **make), rectangle((0, 0, 0.4), 1.2 * Z, 1.4 * Y, **make), bend
    )


def two_faces(step=0.08, seed=0):
    """Two plates in one plane with a gap between them, and a wall at the end of the second."""
    make = {"step": step, "rng": np.random.default_rng(seed)}
    plates = rectangle((0, 0, 0), 1.5 * X, 1.5 * Y, **make), rectangle((2, 0, 0), X, 1.5 * Y, **make)
    return join(*plates, rectangle((3, 0, 0), 0.8 * Z, 1.5 * Y, **make))


def distance(primitive, points):
    """Unsigned distance of each point, written out in NumPy."""
    if primitive.kind == "plane":
        return np.abs(points @ primitive.normal - primitive.offset)
    if primitive.kind == "sphere":
        return np.abs(np.linalg.norm(points - primitive.center[None], axis=1) - primitive.radius)
    offset = points - (primitive.center if primitive.kind == "cylinder" else primitive.apex)[None]
    along = offset @ primitive.axis
    across = np.linalg.norm(offset - along[:, None] * primitive.axis[None], axis=1)
    if primitive.kind == "cylinder":
        return np.abs(across - primitive.radius)
    sine, cosine = np.sin(primitive.half_angle), np.cos(primitive.half_angle)
    behind = along * cosine + across * sine < 0  # nearest to the apex itself
    return np.where(behind, np.hypot(along, across), np.abs(across * cosine - along * sine))


def gap(found, true):
    """The largest difference of two primitives of one kind in lengths and angles, free of sign."""
    assert found.kind == true.kind
    if true.kind == "plane":
        sign = np.sign(found.normal @ true.normal)
        return max(np.linalg.norm(sign * found.normal - true.normal), abs(sign * found.offset - true.offset))
    if true.kind == "sphere":
        return max(np.linalg.norm(found.center - true.center), abs(found.radius - true.radius))
    if true.kind == "cylinder":
        turn = np.linalg.norm(np.cross(found.axis, true.axis))
        return max(
            turn, np.linalg.norm(np.cross(found.center - true.center, true.axis)), abs(found.radius - true.radius)
        )
    moved = np.linalg.norm(found.apex - true.apex), np.linalg.norm(found.axis - true.axis)
    return max(*moved, abs(found.half_angle - true.half_angle))


def same_partition(labels, others):
    """Whether two labellings differ by their numbers only; -1 is no number."""
    pairs = np.unique(np.stack([labels, others], axis=1), axis=0)
    one_to_one = all(len(np.unique(column)) == len(pairs) for column in pairs.T)
    return one_to_one and np.array_equal(labels < 0, others < 0)


@pytest.fixture(scope="session")
def parts():
    """The functions of this file."""
    scans = (boss, ball_and_funnel, fillet, two_faces)
    tools = (rectangle, ring, tube, funnel, ball, join, distance, gap, same_partition)
    return SimpleNamespace(**{function.__name__: function for function in scans + tools})
