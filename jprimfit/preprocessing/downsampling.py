"""Automatic down-sampling of large scans to an even spread of points (paper, section 4.3).

Above 10,000 points the cloud is reduced to 8,192 by farthest-point sampling, which keeps small surfaces and edges
that a random choice would thin out. The rows are kept, so that labels found on the sample can be carried back.
"""

import numpy as np
from jaxtyping import Float32, Int32

from jprimfit.geometry.sampling import optimised_farthest_points
from jprimfit.programs import stored


def downsample(
    points: Float32[np.ndarray, "n 3"], *, max_points: int = 10_000, num_points: int = 8192
) -> Int32[np.ndarray, "m"]:
    """Rows of the points to keep: all, in order, if there are at most max_points, else num_points of them.

    The sample is in farthest-point order and begins with row 0.
    """
    if len(points) <= max_points:
        return np.arange(len(points), dtype=np.int32)
    # The padded length takes few values, so few versions of the search are compiled.
    size = 1 << (len(points) - 1).bit_length()
    padded = np.concatenate([points, np.broadcast_to(points[:1], (size - len(points), 3))])
    mask = np.arange(size) < len(points)
    sample = np.asarray(_farthest_points(padded, mask, num_samples=min(num_points, len(points))))
    # Row 0 comes again only where fewer distinct points exist than are asked for.
    return sample[(sample != sample[0]) | (np.arange(len(sample)) == 0)]


_farthest_points = stored(optimised_farthest_points, static_argnames="num_samples")
