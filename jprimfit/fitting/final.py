"""The parameters that are reported: of all points of a surface, in float64, and without bias from their noise.

While surfaces are sought they are fitted by least squares on a sample, which is fast and which noise biases
on curved ones. What stands in the answer is the solution of the corrected equations (primitives/estimation.py, here
written out for the host) that starts from there. Host code; n points.
"""

import numpy as np
from jaxtyping import Float

from jprimfit.fitting import axial, kinds, planes, segments, spheres
from jprimfit.types import Plane, Primitive, Sphere

FAR = 3.0  # standard deviations beyond which a point of a segment that somebody else drew does not count
NORMAL_SHARE = 0.6745  # the median of |x| for a normal x of standard deviation 1
MAX_WORSE = 1.05  # rms distance over that of least squares: a correction beyond is one of a blob, and is not believed


def settled(primitive: Primitive, points: Float[np.ndarray, "n 3"], *, noise: float | None = None) -> Primitive:
    """The primitive of that kind through the points; the given one where they do not tell it any better.

    noise: where it is given, points may be stray, and those that lie farther off than it, or than most, do not count.
    """
    if noise is not None:
        distance = kinds.distances(primitive, points)
        points = points[distance <= FAR * max(noise, float(np.median(distance)) / NORMAL_SHARE)]
    given = segments.segment(points)
    if not given.size:
        return primitive
    start = kinds.move(primitive, -given.anchor / given.size, 1.0 / given.size)
    if isinstance(start, Plane):
        found = planes.fit(given.local, given.weights)
    elif isinstance(start, Sphere):
        found = spheres.estimate(start, given.local, given.weights)
    else:
        found = axial.estimate(start, given.local, given.weights)
    if not found.ok:
        return primitive
    before, after = (np.square(kinds.distances(one, given.local)).mean() for one in (start, found.primitive))
    is_better = after <= MAX_WORSE**2 * before + np.finfo(np.float32).eps ** 2
    return kinds.move(found.primitive, given.anchor, given.size) if is_better else primitive
