"""Known surfaces and the parts of them that are drawn to test estimates of their parameters.

The four whole surfaces are those of the paper's synthetic test (radius 6, plane of half-extent 1, cylinder of height
-6 to 6, cone of 45 degrees from its apex to height 6); noise is given in parts of 6, for the plane of 1. A patch is the
image of the unit square, even by area. Edges are a0, a1 (height, or first coordinate) and b0, b1 (turn, or second).
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jprimfit.geometry.linalg import HIGHEST
from jprimfit.types import Cone, Cylinder, Plane, Primitive, Sphere

_Z, _ORIGIN, _TURN = np.array([0.0, 0.0, 1.0]), np.zeros(3), 2.0 * math.pi
PLANE = Plane(np.array([1.0, 0.0, 0.0]), np.float64(1.0))
SPHERE = Sphere(_ORIGIN, np.float64(6.0))
CYLINDER = Cylinder(_Z, _ORIGIN, np.float64(6.0))
CONE = Cone(_Z, _ORIGIN, np.float64(math.pi / 4.0))


class Patch(NamedTuple):
    """A part of a known surface."""

    name: str
    truth: Primitive
    edges: tuple[float, float, float, float]  # a0, a1, b0, b1
    free: tuple[int, ...] = ()  # the edges that end the surface: not the poles, nor where it closes on itself

    @property
    def unit(self) -> float:
        """The length that noise is given in parts of."""
        return 1.0 if self.truth.kind == "plane" else 6.0

    def draw(self, generator: np.random.Generator, num_points: int) -> Float[np.ndarray, "n 3"]:
        """Clean points, even by area."""
        square = generator.random((num_points, 2))
        return np.asarray(foot_points(self.truth, np.array(self.edges), square, np), np.float64)


WHOLE = (
    Patch("plane", PLANE, (-1.0, 1.0, -1.0, 1.0), (0, 1, 2, 3)),
    Patch("sphere", SPHERE, (-1.0, 1.0, 0.0, _TURN)),
    Patch("cylinder", CYLINDER, (-6.0, 6.0, 0.0, _TURN), (0, 1)),
    Patch("cone", CONE, (0.0, 6.0, 0.0, _TURN), (1,)),
)
PARTIAL = (
    Patch("sphere, cap of 60 deg", SPHERE, (0.5, 1.0, 0.0, _TURN), (0,)),
    Patch("cylinder, quarter", CYLINDER, (-6.0, 6.0, 0.0, _TURN / 4.0), (0, 1, 2, 3)),
    Patch("cylinder, 30 deg", CYLINDER, (-6.0, 6.0, 0.0, _TURN / 12.0), (0, 1, 2, 3)),
    Patch("cone, quarter frustum", CONE, (4.0, 6.0, 0.0, _TURN / 4.0), (0, 1, 2, 3)),
)
QUARTERS = (
    Patch("plane, quarter", PLANE, (0.0, 1.0, 0.0, 1.0), (0, 1, 2, 3)),
    Patch("sphere, quarter", SPHERE, (-1.0, 1.0, 0.0, _TURN / 4.0), (2, 3)),
    PARTIAL[1],
    Patch("cone, quarter", CONE, (0.0, 6.0, 0.0, _TURN / 4.0), (1, 2, 3)),
)


def foot_points(primitive: Primitive, edges, square, xp=jnp, frame=None) -> Float[Any, "n 3"]:
    """The points of a surface at places in the unit square, of even density by area; xp is NumPy or JAX's.

    frame: rows are two directions across the axis (or in the plane) and the axis; those of the known surfaces if None.
    """
    a0, a1, b0, b1 = edges
    first, second = square[:, 0], b0 + (b1 - b0) * square[:, 1]
    if isinstance(primitive, Plane):
        frame = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]) if frame is None else frame
        local, base = [a0 + (a1 - a0) * first, second, xp.zeros_like(first) + primitive.offset], xp.zeros(3)
    else:
        frame = np.eye(3) if frame is None else frame
        if isinstance(primitive, Sphere):  # equal heights have equal areas
            level, base = a0 + (a1 - a0) * first, primitive.center
            radius, height = primitive.radius * xp.sqrt(1.0 - level**2), primitive.radius * level
        elif isinstance(primitive, Cylinder):
            radius, height, base = primitive.radius, a0 + (a1 - a0) * first, primitive.center
        else:
            height, base = xp.sqrt(a0**2 + (a1**2 - a0**2) * first), primitive.apex
            radius = height * xp.tan(primitive.half_angle)
        local = [radius * xp.cos(second), radius * xp.sin(second), height]
    local = xp.stack(local, axis=1)
    turned = local @ frame if xp is np else jnp.matmul(local, frame, precision=HIGHEST)
    return base[None, :] + turned


def fields(primitive: Primitive, truth: Primitive) -> Float[np.ndarray, " f"]:
    """The parameters that the paper's tables list, in order; of a cylinder the axis point nearest the true center."""
    values = [np.asarray(field, np.float64).reshape(-1) for field in primitive]
    if isinstance(truth, Cylinder):
        axis, center, radius = values
        values = [axis, center + axis * (axis @ (np.asarray(truth.center) - center)), radius]
    return np.concatenate(values)
