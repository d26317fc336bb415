"""What a network is given of one cloud: from the pool with all searches done, or fresh, with all of them to do here.

For a fresh cloud this is the jitted twin of geometry/preparation: one search for the largest neighbourhood serves all.
Letters: n points, g sizes of neighbourhood.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jprimfit.data.examples import Example, Scan
from jprimfit.geometry import hierarchy, linalg, safe
from jprimfit.geometry.filtering import FILTERED, bilateral_normals
from jprimfit.geometry.grouping import gather
from jprimfit.geometry.neighbors import knn
from jprimfit.networks.segmenter import SegmenterConfig
from jprimfit.types import Neighbors

_SWEEPS = 5


def network_inputs(example: Example | Scan, *, model: SegmenterConfig) -> tuple[Any, ...]:
    """points, hierarchy, PCA normals (n, g, 3), curvature (n, g) and queries: the arguments of a segmenter."""
    if isinstance(example, Example):
        levels = hierarchy.from_index_sets(example.points, example.sets, example.mask)
        return example.points, levels, example.local_normals, example.curvature, example.query
    points, mask, spec = example.points, example.mask, model.hierarchy
    sizes = [k for k in model.neighborhoods if k != FILTERED]
    found = knn(points, points, mask, k=max(spec.own_neighbors(0), *sizes, 1))
    levels = hierarchy.build(points, mask, spec=spec, neighbors=found)
    local_normals = jnp.zeros((len(points), len(model.neighborhoods), 3), points.dtype)
    curvature = jnp.zeros(local_normals.shape[:2], points.dtype)
    surfaces: dict[int, Any] = {k: _surface(points, hierarchy.nearest(found, k=k)) for k in sizes}
    if FILTERED in model.neighborhoods:
        normals, bending = surfaces[min(sizes)]
        widest = hierarchy.nearest(found, k=max(sizes))
        surfaces[FILTERED] = bilateral_normals(points, normals, bending, widest, mask)
    for column, k in enumerate(model.neighborhoods):
        normals, bending = surfaces[k]
        local_normals = local_normals.at[:, column].set(normals)
        curvature = curvature.at[:, column].set(bending)
    return points, levels, local_normals, curvature, example.query


def _surface(points: Float[Array, "n 3"], neighbors: Neighbors) -> tuple[Float[Array, "n 3"], Float[Array, "n"]]:
    """Normals and curvature as geometry/normals gives them, without its derivatives."""
    weights = neighbors.mask.astype(points.dtype)
    covariance = jax.vmap(lambda group, weight: linalg.moments(group, weight).covariance)(
        gather(points, neighbors.index), weights
    )
    scaled = safe.divide(covariance, jnp.trace(covariance, axis1=1, axis2=2)[:, None, None])
    return jax.vmap(_least_spread)(scaled)


def _least_spread(matrix: Float[Array, "3 3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Unit eigenvector of the smallest eigenvalue, and that value over the trace; by the cyclic Jacobi method.

    LAPACK's solver, called for thousands of matrices inside one program, can wait for ever for a thread of the CPU.
    """
    vectors = jnp.eye(3, dtype=matrix.dtype)
    for p, q in ((0, 1), (0, 2), (1, 2)) * _SWEEPS:
        gap, twice = matrix[q, q] - matrix[p, p], 2 * matrix[p, q]
        length = jnp.abs(gap) + safe.sqrt(gap * gap + twice * twice)
        tangent = jnp.where(gap < 0, -1, 1) * safe.divide(twice, length)
        cosine = 1 / jnp.sqrt(1 + tangent * tangent)
        sine = tangent * cosine
        first, second = matrix[p], matrix[q]
        matrix = matrix.at[p].set(cosine * first - sine * second).at[q].set(sine * first + cosine * second)
        first, second = matrix[:, p], matrix[:, q]
        matrix = matrix.at[:, p].set(cosine * first - sine * second).at[:, q].set(sine * first + cosine * second)
        first, second = vectors[:, p], vectors[:, q]
        vectors = vectors.at[:, p].set(cosine * first - sine * second).at[:, q].set(sine * first + cosine * second)
    values = jnp.diagonal(matrix)
    least = jnp.argmin(values)
    return vectors[:, least], safe.divide(jnp.maximum(values[least], 0), jnp.sum(values))
