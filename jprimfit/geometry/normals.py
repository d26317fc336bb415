"""Normals and curvature of a cloud by principal components of each neighbourhood.

The normal is the direction in which the neighbours spread least (H. Hoppe et al., 1992), the curvature the share of
that direction in the whole spread (the "surface variation" of M. Pauly et al., 2002). Differentiable with respect to
the points, finite wherever a neighbourhood is degenerate. The float64 twin for whole scans is host.pca_normals.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jprimfit.geometry import linalg, safe
from jprimfit.geometry.grouping import gather
from jprimfit.types import Neighbors

# The smallest variance must stand clear of the middle one by this share of the largest (float32 resolves 1e-6).
MIN_GAP = 1e-4


class Normals(NamedTuple):
    """The local surface at each of n points."""

    normal: Float[Array, "n 3"]  # unit, largest component positive: the sign says nothing of inside and outside
    curvature: Float[Array, "n"]  # smallest eigenvalue / sum of the eigenvalues, in [0, 1/3]; 0 on a plane
    ok: Bool[Array, "n"]  # False where the neighbours coincide, lie on a line or spread alike in all directions


def pca_normals(points: Float[Array, "n 3"], neighbors: Neighbors) -> Normals:
    """Direction of least spread of each point's neighbours, which are rows of points; padding does not count."""
    around = gather(points, neighbors.index)
    weights = neighbors.mask.astype(points.dtype)
    covariance = jax.vmap(lambda group, weight: linalg.moments(group, weight).covariance)(around, weights)
    # A trace of 1 keeps the eigenvalues of a tiny neighbourhood far from the floors that guard their derivatives.
    scaled = safe.divide(covariance, jnp.trace(covariance, axis1=1, axis2=2)[:, None, None])
    eigen = jax.vmap(linalg.eigen_smallest)(scaled)
    smallest, middle, largest = eigen.values[:, 0], eigen.values[:, 1], eigen.values[:, 2]
    curvature = safe.divide(jnp.maximum(smallest, 0), smallest + middle + largest)
    return Normals(eigen.vector, curvature, middle - smallest > MIN_GAP * largest)
