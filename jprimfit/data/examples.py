"""One example for a network: a prepared cloud, and the truth at those of its points that are asked for.

What stands here is what a loader gives and a training step takes. Letters: n points, g neighbourhood sizes, q queries,
i instances. Lengths in the normalised frame.
"""

from typing import Any, NamedTuple

from jaxtyping import Bool, Float, Int

from jprimfit.geometry.hierarchy import IndexSets
from jprimfit.types import Truth


class Example(NamedTuple):
    """A cloud as a scanner saw it, with everything that needs a search already found; a batch has one more axis."""

    points: Float[Any, "n 3"]  # float32, with noise
    mask: Bool[Any, "n"]  # False = padding, a copy of the first point
    local_normals: Float[Any, "n g 3"]  # float32, unit, of PCA at g sizes or filtered, of either sign
    curvature: Float[Any, "n g"]  # float32, the surface variation of the same neighbourhoods, in [0, 1/3]
    sets: IndexSets  # of the points
    query: Int[Any, "q"]  # int32, rows of points at which the network is asked; arange(n) where at all
    truth: Truth  # at the queries: row j of its per-point fields belongs to points[query[j]]


class Scan(NamedTuple):
    """A cloud without what needs a search: training/inputs.py searches on the device. Fields as in Example."""

    points: Float[Any, "n 3"]
    mask: Bool[Any, "n"]
    query: Int[Any, "q"]
    truth: Truth
